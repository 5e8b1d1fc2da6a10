/* stats.cl: what a planner wants to know of a frame, per tile of STATS_TILE x STATS_TILE pixels and peel, and the inverse
 * depths that methods read: both need all of the colours, and reading those is what takes the time.
 *
 * All of it is in inverse depth, in which the CoC of any lens is linear: computed once per frame, good for all lenses.
 * A slot counts as there when it has an inverse depth and alpha, so the void of a frame that is not opaque does not. */

#include "frame.clh"

#define STATS_TILE 16
/* Bins of inverse depth; a tile has a bit for each. */
#define STATS_BINS 64

typedef struct {
    int width, height, pitch, peels, tiles_x, tiles_y;
} StatsSize;

typedef struct {
    float nearest;       /* largest 1/m of the slots that are there, EMPTY for none */
    float farthest;      /* smallest, MAXFLOAT for none */
    float slots;         /* how many are there */
    float solid;         /* how many of them are opaque to the bit */
    uint bins_low;       /* bit b: a slot in bin b of 0 to 31 */
    uint bins_high;      /* 32 to 63 */
    float luminance;     /* sum over the slots, Rec. 709 */
    float step;          /* largest difference in 1/m to the slot to the right or below, where both have a depth */
    float low[4];        /* least of each channel, MAXFLOAT for none */
    float high[4];       /* and the most, 0 for none */
} StatsTile;

/* Differences in inverse depth; 0 where one of the two has none. */
static inline floatn stats_step(floatn w, floatn other)
{
    const floatn low = w < other ? w : other, high = w < other ? other : w;
    return low < 0.0f ? (floatn)(0.0f) : high - low;
}

/* Bins of LANES inverse depths. */
static inline uintn stats_bin(floatn w, float first, float scale)
{
    floatn bin = (w - first) * scale;
    bin = bin < 0.0f ? (floatn)(0.0f) : bin;
    bin = bin > (float)(STATS_BINS - 1) ? (floatn)(STATS_BINS - 1) : bin;
    return to_uintn(bin);
}

/* Sets the bits of the bins of those of LANES inverse depths that there are. */
static inline void stats_mark(uintn *bins_low, uintn *bins_high, floatn w, float first, float scale)
{
    const uintn bin = stats_bin(w, first, scale);
    const uintn bit = w < 0.0f ? (uintn)(0u) : (uintn)(1u) << (bin & 31u);
    *bins_low |= bin < 32u ? bit : (uintn)(0u);
    *bins_high |= bin < 32u ? (uintn)(0u) : bit;
}

/* stats_tiles: inverse depth of every slot, and ranges of depth and colour of each tile of each peel.
 * reads   depth      float[peels][height][width]      m, inf = sky or nothing there
 *         color      float[peels][height][width][4]
 * writes  inv_depth  float[peels][height][pitch]      as frame_inverse_depth
 *         tiles      StatsTile[peels][tiles_y][tiles_x]
 * scalars first, scale  bin of w is (w - first) * scale, clamped
 * range   3-D, one item per tile and peel, any local size */
__kernel void stats_tiles(__global float *restrict inv_depth, __global StatsTile *restrict tiles,
                          const __global float *restrict depth, const __global float *restrict color, StatsSize size,
                          float nothing, float first, float scale)
{
    const int tx = get_global_id(0), ty = get_global_id(1), m = get_global_id(2);
    if (tx >= size.tiles_x || ty >= size.tiles_y || m >= size.peels) return;
    const int x = STATS_TILE * tx, n = size.width - x;
    const int y0 = STATS_TILE * ty;
    const int rows = size.height - y0 < STATS_TILE ? size.height - y0 : STATS_TILE;
    const floatn none = (floatn)(MAXFLOAT), zero = (floatn)(0.0f), one = (floatn)(1.0f);
    const size_t first_row = (size_t)m * size.height + y0;
    __global float *inv = inv_depth + first_row * size.pitch + x;
    const __global float *z = depth + first_row * size.width + x;
    const __global float *rgba = color + (first_row * size.width + x) * 4;
    const size_t color_row = (size_t)size.width * 4;

    /* Depth alone first: most tiles turn out to be full or empty, and need no masks. */
    floatn nearest = (floatn)(EMPTY), farthest = none, step = zero;
    for (int r = 0; r < STATS_TILE; r += LANES) {
        floatn above = (floatn)(EMPTY);
        for (int i = 0; i < rows; i++) {
            const __global float *from = rgba + i * color_row + 4 * r, *at = z + (size_t)i * size.width + r;
            const floatn w = inverse_run(at, from, n - r, nothing);
            const float next = n - r > LANES ? inverse_of(at[LANES], load_pixel(from + 4 * LANES), nothing) : EMPTY;
            store_lanes(inv + (size_t)i * size.pitch + r, w);
            nearest = greater(nearest, w);
            farthest = lesser(farthest, w);
            step = greater(step, greater(stats_step(w, lanes_before(w, next)), stats_step(w, above)));
            above = w;
        }
        if (y0 + rows < size.height) {
            const floatn below = inverse_run(z + (size_t)rows * size.width + r, rgba + rows * color_row + 4 * r, n - r,
                                             nothing);
            step = greater(step, stats_step(above, below));
        }
    }
    if (tx == size.tiles_x - 1)
        for (int i = 0; i < rows; i++)
            for (int past = STATS_TILE; x + past < size.pitch; past += LANES)
                store_lanes(inv + (size_t)i * size.pitch + past, (floatn)(EMPTY));
    StatsTile tile;
    tile.nearest = greatest_lane(nearest);
    tile.farthest = MAXFLOAT;
    tile.slots = tile.solid = tile.luminance = 0.0f;
    tile.step = greatest_lane(step);
    floatn low = none, high = zero, sum = zero;
    uintn bins_low = (uintn)(0u), bins_high = (uintn)(0u);
    int masked = tile.nearest >= 0.0f;

    if (n >= STATS_TILE && least_lane(farthest) >= 0.0f) {
        for (int i = 0; i < rows; i++) {
#pragma unroll
            for (int q = 0; q < 4 * STATS_TILE; q += LANES) {
                const floatn c = load_lanes(rgba + i * color_row + q);
                low = lesser(low, c);
                high = greater(high, c);
                sum += c;
            }
        }
        if (least_pixel(low).w >= 1.0f) {
            masked = 0;
            for (int i = 0; i < rows; i++)
                for (int r = 0; r < STATS_TILE; r += LANES)
                    stats_mark(&bins_low, &bins_high, load_lanes(inv + (size_t)i * size.pitch + r), first, scale);
            tile.farthest = least_lane(farthest);
            tile.slots = tile.solid = (float)(rows * STATS_TILE);
        } else { /* some of it is glass, or nothing */
            low = none;
            high = sum = zero;
        }
    }
    if (masked) {
        floatn slots = zero, solid = zero;
        nearest = (floatn)(EMPTY);
        farthest = none;
        for (int i = 0; i < rows; i++)
            for (int r = 0; r < STATS_TILE && r < n; r += LANES) {
                const __global float *from = rgba + i * color_row + 4 * r;
                const floatn w = load_lanes(inv + (size_t)i * size.pitch + r);
                floatn c[4];
                for (int q = 0; q < 4; q++) {
                    const int left = n - r - PIXELS * q;
                    c[q] = left > 0 ? load_pixels(from + LANES * q, left) : zero;
                }
                const floatn alpha = CHANNEL_OF(c, ALPHA);
                const intn there = (w >= 0.0f) & (alpha > 0.0f);
                const floatn is = there ? one : zero;
                nearest = there ? greater(nearest, w) : nearest;
                farthest = there ? lesser(farthest, w) : farthest;
                slots += is;
                solid += alpha >= 1.0f ? is : zero;
                stats_mark(&bins_low, &bins_high, there ? w : (floatn)(EMPTY), first, scale);
                const floatp part[4] = FOUR_PARTS(is);
                for (int q = 0; q < 4; q++) {
                    const floatn mask = spread(part[q]), held = c[q] * mask;
                    low = lesser(low, mask > 0.0f ? held : none);
                    high = greater(high, held);
                    sum += held;
                }
            }
        tile.nearest = greatest_lane(nearest);
        tile.farthest = least_lane(farthest);
        tile.slots = sum_lanes(slots);
        tile.solid = sum_lanes(solid);
    }
    tile.bins_low = or_lanes(bins_low);
    tile.bins_high = or_lanes(bins_high);
    const float4 rgb = sum_pixels(sum), low4 = least_pixel(low), high4 = greatest_pixel(high);
    tile.luminance = 0.2126f * rgb.x + 0.7152f * rgb.y + 0.0722f * rgb.z;
    tile.low[0] = low4.x, tile.low[1] = low4.y, tile.low[2] = low4.z, tile.low[3] = low4.w;
    tile.high[0] = high4.x, tile.high[1] = high4.y, tile.high[2] = high4.z, tile.high[3] = high4.w;
    tiles[((size_t)m * size.tiles_y + ty) * size.tiles_x + tx] = tile;
}

/* stats_histogram: slots per bin of inverse depth, on one row of STATS_TILE.
 * reads   inv_depth  float[peels][height][pitch]     1/m
 *         color      float[peels][height][width][4]
 * writes  histogram  int[peels][tiles_y][STATS_BINS]
 * range   2-D, one item per row of tiles and peel, any local size */
__kernel void stats_histogram(__global int *restrict histogram, const __global float *restrict inv_depth,
                              const __global float *restrict color, StatsSize size, float first, float scale)
{
    const int ty = get_global_id(0), m = get_global_id(1);
    if (ty >= size.tiles_y || m >= size.peels) return;
    int y = STATS_TILE * ty + (5 * ty) % STATS_TILE;
    y = y < size.height ? y : size.height - 1;
    const size_t row = (size_t)m * size.height + y;
    const __global float *inv = inv_depth + row * size.pitch;
    const __global float *rgba = color + row * size.width * 4;
    int counts[STATS_BINS];
    for (int b = 0; b < STATS_BINS; b++) counts[b] = 0;
    for (int x = 0; x < size.width; x++) {
        const float w = inv[x];
        if (!(w >= 0.0f && rgba[4 * x + 3] > 0.0f)) continue;
        float bin = (w - first) * scale;
        bin = bin < 0.0f ? 0.0f : bin;
        bin = bin > (float)(STATS_BINS - 1) ? (float)(STATS_BINS - 1) : bin;
        counts[(int)bin]++;
    }
    __global int *to = histogram + ((size_t)m * size.tiles_y + ty) * STATS_BINS;
    for (int b = 0; b < STATS_BINS; b++) to[b] = counts[b];
}
