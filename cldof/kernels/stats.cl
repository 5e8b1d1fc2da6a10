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

static inline float16 lesser(float16 a, float16 b) { return a < b ? a : b; }
static inline float16 greater(float16 a, float16 b) { return a > b ? a : b; }

static inline float8 lesser8(float8 a, float8 b) { return a < b ? a : b; }

static inline float min16(float16 v)
{
    float8 a = v.lo < v.hi ? v.lo : v.hi;
    float4 b = a.lo < a.hi ? a.lo : a.hi;
    float2 c = b.lo < b.hi ? b.lo : b.hi;
    return c.x < c.y ? c.x : c.y;
}

static inline float max16(float16 v)
{
    return -min16(-v);
}

static inline uint or16(uint16 v)
{
    uint8 a = v.lo | v.hi;
    uint4 b = a.lo | a.hi;
    return b.x | b.y | b.z | b.w;
}

/* Differences in inverse depth; 0 where one of the two has none. */
static inline float16 stats_step(float16 w, float16 other)
{
    const float16 low = w < other ? w : other, high = w < other ? other : w;
    return low < 0.0f ? (float16)(0.0f) : high - low;
}

/* Bins of 16 inverse depths. */
static inline uint16 stats_bin(float16 w, float first, float scale)
{
    float16 bin = (w - first) * scale;
    bin = bin < 0.0f ? (float16)(0.0f) : bin;
    bin = bin > (float)(STATS_BINS - 1) ? (float16)(STATS_BINS - 1) : bin;
    return convert_uint16(bin);
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
    const float16 none = (float16)(MAXFLOAT), zero = (float16)(0.0f), one = (float16)(1.0f);
    const size_t first_row = (size_t)m * size.height + y0;
    __global float *inv = inv_depth + first_row * size.pitch + x;
    const __global float *z = depth + first_row * size.width + x;
    const __global float *rgba = color + (first_row * size.width + x) * 4;
    const size_t color_row = (size_t)size.width * 4;

    /* Depth alone first: most tiles turn out to be full or empty, and need no masks. */
    float16 nearest = (float16)(EMPTY), farthest = none, step = zero, above = nearest;
    for (int i = 0; i < rows; i++) {
        const __global float *from = rgba + i * color_row, *at = z + (size_t)i * size.width;
        const float16 w = inverse_run(at, from, n, nothing);
        const float next = n > STATS_TILE
                               ? inverse_of(at[STATS_TILE], load_pixel(from + 4 * STATS_TILE), nothing)
                               : EMPTY;
        const float16 right = (float16)(w.s12345678, w.s9abc, w.sde, w.sf, next);
        store_quad(inv + (size_t)i * size.pitch, w);
        nearest = greater(nearest, w);
        farthest = lesser(farthest, w);
        step = greater(step, greater(stats_step(w, right), stats_step(w, above)));
        above = w;
    }
    if (y0 + rows < size.height) {
        const float16 below = inverse_run(z + (size_t)rows * size.width, rgba + rows * color_row, n, nothing);
        step = greater(step, stats_step(above, below));
    }
    if (tx == size.tiles_x - 1)
        for (int i = 0; i < rows; i++)
            for (int past = STATS_TILE; x + past < size.pitch; past += STATS_TILE)
                store_quad(inv + (size_t)i * size.pitch + past, (float16)(EMPTY));
    StatsTile tile;
    tile.nearest = max16(nearest);
    tile.farthest = MAXFLOAT;
    tile.slots = tile.solid = tile.luminance = 0.0f;
    tile.step = max16(step);
    float16 low = none, high = zero, sum = zero;
    uint16 bins_low = (uint16)(0u), bins_high = (uint16)(0u);
    int masked = tile.nearest >= 0.0f;

    if (n >= STATS_TILE && min16(farthest) >= 0.0f) {
        for (int i = 0; i < rows; i++) {
#pragma unroll
            for (int q = 0; q < 4; q++) {
                const float16 c = load_quad(rgba + i * color_row + 16 * q);
                low = lesser(low, c);
                high = greater(high, c);
                sum += c;
            }
        }
        float4 alpha = low.s37bf;
        if (alpha.x >= 1.0f && alpha.y >= 1.0f && alpha.z >= 1.0f && alpha.w >= 1.0f) {
            masked = 0;
            for (int i = 0; i < rows; i++) {
                const uint16 b = stats_bin(load_quad(inv + (size_t)i * size.pitch), first, scale);
                const uint16 bit = (uint16)(1u) << (b & 31u);
                bins_low |= b < 32u ? bit : (uint16)(0u);
                bins_high |= b < 32u ? (uint16)(0u) : bit;
            }
            tile.farthest = min16(farthest);
            tile.slots = tile.solid = (float)(rows * STATS_TILE);
        } else { /* some of it is glass, or nothing */
            low = none;
            high = sum = zero;
        }
    }
    if (masked) {
        float16 slots = zero, solid = zero;
        nearest = (float16)(EMPTY);
        farthest = none;
        for (int i = 0; i < rows; i++) {
            const __global float *from = rgba + i * color_row;
            const float16 w = load_quad(inv + (size_t)i * size.pitch);
            float16 c[4];
            for (int q = 0; q < 4; q++) {
                const int left = n - 4 * q;
                c[q] = left >= 4 ? load_quad(from + 16 * q) : left > 0 ? load_quad_part(from + 16 * q, left) : zero;
            }
            const float16 alpha = (float16)(c[0].s37bf, c[1].s37bf, c[2].s37bf, c[3].s37bf);
            const int16 there = (w >= 0.0f) & (alpha > 0.0f);
            const float16 is = there ? one : zero;
            nearest = there ? greater(nearest, w) : nearest;
            farthest = there ? lesser(farthest, w) : farthest;
            slots += is;
            solid += alpha >= 1.0f ? is : zero;
            const uint16 b = stats_bin(w, first, scale);
            const uint16 bit = there ? (uint16)(1u) << (b & 31u) : (uint16)(0u);
            bins_low |= b < 32u ? bit : (uint16)(0u);
            bins_high |= b < 32u ? (uint16)(0u) : bit;
            const float4 part[4] = {is.s0123, is.s4567, is.s89ab, is.scdef};
            for (int q = 0; q < 4; q++) {
                const float16 mask = spread(part[q]), held = c[q] * mask;
                low = lesser(low, mask > 0.0f ? held : none);
                high = greater(high, held);
                sum += held;
            }
        }
        tile.nearest = max16(nearest);
        tile.farthest = min16(farthest);
        tile.slots = sum16(slots);
        tile.solid = sum16(solid);
    }
    tile.bins_low = or16(bins_low);
    tile.bins_high = or16(bins_high);
    const float4 rgb = (sum.s0123 + sum.s4567) + (sum.s89ab + sum.scdef);
    tile.luminance = 0.2126f * rgb.x + 0.7152f * rgb.y + 0.0722f * rgb.z;
    const float8 low8 = lesser8(low.lo, low.hi), high8 = -lesser8(-high.lo, -high.hi);
    const float4 low4 = low8.lo < low8.hi ? low8.lo : low8.hi, high4 = high8.lo > high8.hi ? high8.lo : high8.hi;
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
