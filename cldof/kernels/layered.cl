/* layered.cl: depth of field from peeled layers (Schedl & Wimmer 2012).
 *
 * The peels are split into depth layers by matting functions and composed from both ends towards the layer in focus,
 * blurring after each layer (their eq. 13), so that a layer is blurred by all steps between it and the focus.
 *
 * Inner images are float[height][pitch][4], pitch a multiple of 16 pixels. Channel 3 is *coverage*: how much of the
 * pixel the layers so far account for. Where a frame lets the void behind the scene through, the void is given as an
 * opaque black surface at infinity, so that coverage tells a seam between layers (divide it out, section 3.3.1) from a
 * view past the scene (leave it); a second run with ALPHA_RUN composes the surfaces' alpha in place of their colour.
 *
 * Work goes by tiles of LAYERED_TILE x FIR_ROWS pixels. Tiles into which a layer has nothing to bring and no blur has
 * reached yet are not computed. */

#include "common.clh"
#include "fir.clh"
#include "slots.clh"

#define LAYERED_MAX_LAYERS 32
#define LAYERED_TILE 64
/* Pixels of a row whose matting an item works out at a time, LANES to LAYERED_TILE. More than LANES takes an array that
 * CPUs keep in their first cache and GPUs do not keep in registers. */
#ifndef LAYERED_SPAN
#define LAYERED_SPAN LANES
#endif
#define LAYERED_BLOCKS (LAYERED_SPAN / LANES)
/* Below this coverage nothing is known about a pixel, and the result is exactly 0. */
#define LAYERED_MIN_COVERAGE 1e-4f

/* 1: the frame's image is not opaque, so slots with nothing in them are black surfaces at infinity. */
#ifndef LAYERED_VOID
#define LAYERED_VOID 0
#endif
/* 1: carry the surfaces' alpha in channel 0 in place of colour; only with LAYERED_VOID. */
#ifndef LAYERED_ALPHA_RUN
#define LAYERED_ALPHA_RUN 0
#endif

/* 1: some slots are neither empty nor opaque, and are shared out; not with LAYERED_PAPER. */
#ifndef LAYERED_GLASS
#define LAYERED_GLASS 0
#endif
/* 1: matting functions as published, without what layered_weight adds. */
#ifndef LAYERED_PAPER
#define LAYERED_PAPER 0
#endif
/* Slots at least this opaque take the matting weights of opaque ones. */
#define LAYERED_OPAQUE 0.998f

/* Matting functions of all layers, per layer (up scale, up offset, down scale, down offset): with w the inverse depth,
 * clamp(w * scale + offset, 0, 1) rises over the interval before the layer and falls over the one behind it.
 * Reach is how far, in px, a layer's blur opens a gap to its neighbour; around is the distance at which to look for the
 * rest of a surface, about one sigma of the layer's blur. */
typedef struct {
    float4 layer[LAYERED_MAX_LAYERS];
    float reach[LAYERED_MAX_LAYERS];
    int around[LAYERED_MAX_LAYERS];
} LayeredMatting;

/* What a layer needs of that: its own functions and those of the layer before it (zeros for the first). */
typedef struct {
    float4 own, before;
    float reach;
    int around;
} LayeredLayer;

typedef struct {
    int width, height, pitch, peels, tiles_x, tiles_y;
} LayeredSize;

typedef struct {
    int layer;
    int in_front;    /* 1: what is composed so far lies in front of this layer, 0: behind it */
    int below;       /* 0: nothing composed so far, 1: `image`, where `reached` says so, 2: `image` everywhere */
    int radius_in;   /* column filter still owed to `image` */
    int taps_in;     /* and where its taps start */
    int radius_out;  /* row filter of this step */
    int taps_out;
    int segment;     /* pixels of a row a work-group owns, a multiple of LAYERED_TILE */
} LayeredStep;

static inline LayeredLayer layered_layer(const __global LayeredMatting *matting, int k)
{
    LayeredLayer layer = {matting->layer[k], k > 0 ? matting->layer[k - 1] : (float4)(0.0f), matting->reach[k],
                          matting->around[k]};
    return layer;
}

/* How broad the surfaces of LANES slots of the first peel are, for the blur of a layer. */
static inline floatn layered_breadth(const __global float *inv_depth, floatn w, LayeredSize size, LayeredLayer layer,
                                      int x, int y)
{
    return breadth_of(inv_depth, w, x, y, size.width, size.height, size.pitch, layer.around, layer.before.z);
}

/* Weights of LANES slots in a layer: omega for the first peel (eq. 4), omega-dot for the others (eq. 3), with three changes.
 *
 * Hidden slots may fall as gently as visible ones where the slot before them already stands in this layer or in front of
 * it (has not begun to fall): there nothing shows through that a nearer surface hides.
 *
 * Slots of the interval before the layer are there to close the seam where a surface goes on into the layer and the
 * blurred end of the layer before it lets through what is behind. The seam is as wide as the blur, so the rise is cut
 * to that width: a surface that does not slope into the layer brings nothing, where the paper's full rise would widen
 * its silhouette. What crosses the whole interval from one pixel to the next is a silhouette and no slope. A visible
 * surface that is not broad begins in the layer without weight, see below; before that it must have none either, or it
 * would show twice while the focus moves on.
 *
 * A visible slot in the layer's own interval is also in the layer before, with weight 1 - t, t being how far it is into
 * the interval. Inside a broad surface it takes its full weight behind that, or the background would show through; of a
 * thin one, whose blurred coverage is small, both would add up to more than there is. With b the breadth of the surface
 * t / (1 - (1 - t) b) is right for both. */
static inline floatn layered_weight(const __global float *inv_depth, const __global float *inv, floatn w,
                                     floatn before, LayeredLayer layer, int peel, LayeredSize size, int x, int y)
{
    const floatn zero = (floatn)(0.0f), one = (floatn)(1.0f);
    floatn rising = w * layer.own.x + layer.own.y;
    floatn falling = w * layer.own.z + layer.own.w;
    floatn up = clamp01(rising), down = clamp01(falling);
    floatn at_once = falling >= 1.0f ? one : zero;
#if LAYERED_PAPER
    down = peel > 0 ? at_once : down;
#else
    if (peel > 0) down = before * layer.own.z + layer.own.w >= 1.0f ? down : at_once;
    const intn between = (rising > 0.0f) & (rising < 1.0f);
    if (any_lane(between)) {
        floatn part = slope_of(inv, w, x, y, size.height, size.pitch, -1.0f / layer.own.x);
        part *= -layer.own.x * layer.reach;
        part = part > 1.0f ? one : part;
        part = part < 1e-3f ? (floatn)(1e-3f) : part;
        up = clamp01((rising - 1.0f) / part + 1.0f);
        const intn early = between & (up > 0.0f);
        if (peel == 0 && any_lane(early)) {
            floatn broad = layered_breadth(inv_depth, w, size, layer, x, y) * 2.0f - 1.0f;
            up = early ? up * clamp01(broad) : up;
        }
    }
    floatn rest = clamp01(w * layer.before.z + layer.before.w); /* 1 - t */
    const intn shared = (rising >= 1.0f) & (falling >= 1.0f) & (w >= 0.0f) & (rest > 0.0f);
    if (peel == 0 && any_lane(shared)) {
        floatn others = 1.0f - rest * layered_breadth(inv_depth, w, size, layer, x, y);
        up = shared ? (1.0f - rest) / (others > 1e-3f ? others : (floatn)(1e-3f)) : up;
        up = (shared & (others <= 1e-3f)) ? one : up;
    }
#endif
    return w < 0.0f ? zero : up * down;
}

#if LAYERED_VOID
/* PIXELS slots of a peel as the current run composes them. The void behind the last slot stands at its depth, that of an
 * empty slot at infinity. */
static inline floatn layered_void(floatn c, floatp w, int is_last)
{
#if LAYERED_ALPHA_RUN
    c = c.ALPHAS * every_pixel((float4)(1.0f, 0.0f, 0.0f, 0.0f)) + c * every_pixel((float4)(0.0f, 0.0f, 0.0f, 1.0f));
#endif
    floatp a = c.ALPHA;
    a = w == 0.0f && a == 0.0f ? (floatp)(1.0f) : a;
    c.ALPHA = is_last ? (floatp)(1.0f) : a;
    return c;
}
#endif

#if LAYERED_GLASS
/* Weights of PIXELS slots that are not opaque. An opaque slot may stand in several layers at full weight, since more of
 * the same paint changes nothing; glass must not be counted twice. It is shared out between the layer whose interval it
 * is in and the one before, so that both together let through exactly 1 - alpha: (1 - t) in front of
 * t / (1 - (1 - t) * alpha), t being how far the slot is into its interval. */
static inline floatp layered_glass(floatp weight, floatp alpha, floatp w, floatp before, LayeredLayer layer, int peel)
{
    floatp t = 1.0f - (w * layer.before.z + layer.before.w);
    t = t > 1.0f ? (floatp)(1.0f) : t;
    if (peel > 0) t = before * layer.before.z + layer.before.w >= 1.0f ? t : (floatp)(1.0f);
    floatp rest = 1.0f - (1.0f - t) * alpha;
    floatp rising = w * layer.own.x + layer.own.y, falling = w * layer.own.z + layer.own.w;
    floatp glass = falling < 1.0f ? weight : t / (rest > 1e-3f ? rest : (floatp)(1e-3f));
    glass = rising >= 1.0f && w >= 0.0f ? glass : (floatp)(0.0f);
    return alpha < LAYERED_OPAQUE ? glass : weight;
}
#endif

/* One layer (eq. 2) at LAYERED_SPAN pixels from x on, a multiple of that, as far as `open` has a bit for the block of
 * LANES: weighted slots, composed front to back. `peels` has a bit for each peel that brings something to this tile.
 *
 * A peel's weights come before its colours. What to load is known by then, and loads that wait for memory go on side by
 * side, where a block at a time would begin with each when the one before is decided. */
static inline void layered_span(floatn quad[LAYERED_BLOCKS][4], const __global float *color,
                                const __global float *inv_depth, LayeredSize size, LayeredLayer layer, uint peels,
                                uint open, int x, int y)
{
    for (int b = 0; b < LAYERED_BLOCKS; b++)
#pragma unroll
        for (int q = 0; q < 4; q++) quad[b][q] = (floatn)(0.0f);
    for (int m = 0; m < size.peels && open; m++) {
        if (!(peels >> m & 1u)) continue;
        const size_t row = (size_t)m * size.height + y;
        const __global float *inv = inv_depth + row * size.pitch + x;
        floatn weight[LAYERED_BLOCKS];
#if LAYERED_GLASS
        floatn in_front[LAYERED_BLOCKS];
#endif
        uint brought = 0;
        for (int b = 0; b < LAYERED_BLOCKS; b++) {
            if (!(open >> b & 1u)) continue;
            const __global float *at = inv + LANES * b;
            const floatn w = load_lanes(at);
            floatn before = m > 0 ? load_lanes(at - (size_t)size.height * size.pitch) : w;
            /* Slots between that hold nothing do not count. */
            for (int p = 2; p <= m; p++) {
                const intn is_past_nothing = (before < 0.0f) & (w >= 0.0f);
                if (!any_lane(is_past_nothing)) break;
                before = is_past_nothing ? load_lanes(at - (size_t)p * size.height * size.pitch) : before;
            }
            weight[b] = layered_weight(inv_depth, at, w, before, layer, m, size, x + LANES * b, y);
#if LAYERED_GLASS
            in_front[b] = before;
#endif
            brought |= any_lane(weight[b] > 0.0f) ? 1u << b : 0u;
        }
        for (int b = 0; b < LAYERED_BLOCKS; b++) {
            if (!(brought >> b & 1u)) continue;
            const __global float *rgba = color + (row * size.width + x + LANES * b) * 4;
            floatp weights[4] = FOUR_PARTS(weight[b]);
#if LAYERED_VOID || LAYERED_GLASS
            const floatn w = load_lanes(inv + LANES * b);
            const floatp inverse[4] = FOUR_PARTS(w);
#endif
#if LAYERED_GLASS
            const floatp inverse_before[4] = FOUR_PARTS(in_front[b]);
#endif
#pragma unroll
            for (int q = 0; q < 4; q++) {
                int valid = size.width - x - LANES * b - PIXELS * q;
                if (valid <= 0) continue;
                floatn c = load_pixels(rgba + LANES * q, valid);
#if LAYERED_VOID
                c = layered_void(c, inverse[q], m == size.peels - 1);
#endif
#if LAYERED_GLASS
                weights[q] = layered_glass(weights[q], c.ALPHA, inverse[q], inverse_before[q], layer, m);
#endif
                quad[b][q] = over(quad[b][q], c * spread(weights[q]));
            }
            /* Nothing shows through opaque pixels: no need to read the peels behind them. */
            const floatn least = lesser(lesser(quad[b][0], quad[b][1]), lesser(quad[b][2], quad[b][3]));
            open &= any_lane(least.ALPHAS < 1.0f) ? ~0u : ~(1u << b);
        }
    }
}

/* Put the blocks of a span that `within` has bits for into lines; `line` is where its first pixel goes, or would go. */
static inline void layered_put(__local float *line, floatn quad[LAYERED_BLOCKS][4], uint within)
{
    for (int b = 0; b < LAYERED_BLOCKS; b++) {
        if (!(within >> b & 1u)) continue;
#pragma unroll
        for (int q = 0; q < 4; q++)
#pragma unroll
            for (int i = 0; i < PIXELS; i++)
                store_pixel_local(line + (LANES * b + PIXELS * q + i) * FIR_LINE, pixel_of(quad[b][q], i));
    }
}

/* Bits for the blocks of the span at x that begin at `first` or behind it and before `end`. */
static inline uint layered_within(int x, int first, int end)
{
    uint within = 0;
    for (int b = 0; b < LAYERED_BLOCKS; b++) within |= x + LANES * b >= first && x + LANES * b < end ? 1u << b : 0u;
    return within;
}

/* Whether the PIXELS pixels at `line` are opaque in all rows: then there is no point in filtering what lies behind. */
static inline int layered_hides(const __local float *line)
{
    floatn covered = (floatn)(0.0f);
#pragma unroll
    for (int i = 0; i < PIXELS; i++)
#pragma unroll
        for (int row = 0; row < 4 * FIR_ROWS; row += LANES) covered += load_lanes_local(line + i * FIR_LINE + row);
    return sum_pixels(covered).w >= (float)(PIXELS * FIR_ROWS);
}

/* Compose FIR_RUN rows of PIXELS filtered pixels with those at `line`, where there are any. */
static inline void layered_add(__local float *line, floatn filtered[FIR_RUN], int is_there, int in_front)
{
    fir_turn(filtered);
#pragma unroll
    for (int i = 0; i < FIR_RUN; i++) {
        __local float *at = line + fir_place(i);
        floatn v = filtered[i];
        if (is_there) {
            floatn layer = load_lanes_local(at);
            v = in_front ? over(v, layer) : over(layer, v);
        }
        store_lanes_local(at, v);
    }
}

/* Whether an image is there in a tile or in any whose rows its column filter would bring there; `below` as in
 * LayeredStep. */
static inline int layered_is_reached(const __global int *reached, int below, int tx, int ty, int radius,
                                     LayeredSize size)
{
    if (below != 1) return below;
    int first = clamp_index(ty * FIR_ROWS - radius, size.height - 1) / FIR_ROWS;
    int last = clamp_index(ty * FIR_ROWS + FIR_ROWS - 1 + radius, size.height - 1) / FIR_ROWS;
    int any = 0;
    for (int r = first; r <= last; r++) any |= reached[r * size.tiles_x + tx];
    return any;
}

/* layered_matting: the frame's matting functions as a buffer. Mesa 22.3 ends the process in kernels that take a struct
 * with an array by value and look an element up in it.
 * writes  matting  LayeredMatting
 * range   1-D, one item */
__kernel void layered_matting(__global LayeredMatting *matting, LayeredMatting given) { *matting = given; }

/* layered_classify: which peels bring something to which layer, per tile.
 * reads   inv_depth    float[peels][height][pitch]
 *         matting      LayeredMatting
 * writes  tile_peels   uint[layers][tiles_y][tiles_x]  bit m: peel m has a slot with weight in the layer
 * range   2-D, one item per tile, any local size */
__kernel void layered_classify(__global uint *restrict tile_peels, const __global float *restrict inv_depth,
                               const __global LayeredMatting *restrict matting, LayeredSize size, int layers)
{
    const int tx = get_global_id(0), ty = get_global_id(1);
    if (tx >= size.tiles_x || ty >= size.tiles_y) return;
    const int x_end = (tx + 1) * LAYERED_TILE < size.pitch ? (tx + 1) * LAYERED_TILE : size.pitch;
    const int y_end = (ty + 1) * FIR_ROWS < size.height ? (ty + 1) * FIR_ROWS : size.height;
    for (int k = 0; k < layers; k++) tile_peels[((size_t)k * size.tiles_y + ty) * size.tiles_x + tx] = 0;
    for (int m = 0; m < size.peels; m++) {
        intn hits[LAYERED_MAX_LAYERS];
        for (int k = 0; k < layers; k++) hits[k] = (intn)(0);
        for (int x = tx * LAYERED_TILE; x < x_end; x += LANES) {
            /* A weight is non-zero on an interval of w, so the nearest and farthest slots of a column of the tile tell
             * which layers it can touch. */
            floatn nearest = (floatn)(EMPTY), farthest = (floatn)(MAXFLOAT);
            for (int y = ty * FIR_ROWS; y < y_end; y++) {
                floatn w = load_lanes(inv_depth + ((size_t)m * size.height + y) * size.pitch + x);
                nearest = w > nearest ? w : nearest;
                w = w < 0.0f ? (floatn)(MAXFLOAT) : w;
                farthest = w < farthest ? w : farthest;
            }
            for (int k = 0; k < layers; k++) {
                float4 f = matting->layer[k]; /* `up` falls and `down` rises with w: the CoC falls as w grows */
                hits[k] |= (farthest * f.x + f.y > 0.0f) & (nearest * f.z + f.w > 0.0f) & (nearest >= 0.0f);
            }
        }
        for (int k = 0; k < layers; k++) {
            if (any_lane(hits[k])) tile_peels[((size_t)k * size.tiles_y + ty) * size.tiles_x + tx] |= 1u << m;
        }
    }
}

/* layered_step: one step of the cascade, (image filtered along the columns, over or under the layer) filtered along the
 * rows. The column filter that belongs to the row filter is left to whoever reads `out`, who also owes `image` its own.
 * source  Schedl & Wimmer 2012, eqs. 2-4 and 13
 * reads   image       float[height][pitch][4]           blurred along the rows only, or whole with radius_in = 0
 *         reached     int[tiles_y][tiles_x]             where image is not zero
 *         color       float[peels][height][width][4]
 *         inv_depth   float[peels][height][pitch]
 *         tile_peels  uint[layers][tiles_y][tiles_x]
 *         taps        float[]                           all FIR taps
 *         matting     LayeredMatting
 * writes  out         float[height][pitch][4]
 *         reached_out int[tiles_y][tiles_x]
 * range   2-D groups: (segments of a row, blocks of FIR_ROWS rows); local size (any, 1)
 * local   lines  float[segment + 2*halo][FIR_LINE], halo = radius_out rounded up to a multiple of 16
 *         state  int[2 * segment / LAYERED_TILE + 2*ceil(halo / LAYERED_TILE)]  per tile: 1 blur reached it, 2 layer does;
 *                then per tile of the segment whether anything is written */
__kernel void layered_step(__global float *restrict out, __global int *restrict reached_out,
                           const __global float *restrict image, const __global int *restrict reached,
                           const __global float *restrict color, const __global float *restrict inv_depth,
                           const __global uint *restrict tile_peels, const __global float *restrict taps,
                           const __global LayeredMatting *restrict matting, LayeredSize size, LayeredStep step,
                           __local float *restrict lines, __local int *restrict state)
{
    const int lid = get_local_id(0), items = get_local_size(0);
    const int halo = (step.radius_out + 15) & ~15; /* blocks of LANES pixels stay aligned */
    const int halo_tiles = (halo + LAYERED_TILE - 1) / LAYERED_TILE;
    const int line_width = step.segment + 2 * halo;
    const int x0 = (int)get_group_id(0) * step.segment;
    const int ty = (int)get_group_id(1);
    const int y0 = ty * FIR_ROWS;
    const int segment_tiles = step.segment / LAYERED_TILE;
    __local int *is_written = state + segment_tiles + 2 * halo_tiles;
    const int tile0 = x0 / LAYERED_TILE - halo_tiles; /* state[0] */
    const LayeredLayer own = layered_layer(matting, step.layer);
    const __global uint *layer_peels = tile_peels + ((size_t)step.layer * size.tiles_y + ty) * size.tiles_x;

    /* What can be non-zero here, before touching any pixel. */
    for (int t = lid; t < segment_tiles + 2 * halo_tiles; t += items) {
        int tx = tile0 + t, s = 0;
        if (tx >= 0 && tx < size.tiles_x) {
            s = layer_peels[tx] ? 2 : 0;
            s |= layered_is_reached(reached, step.below, tx, ty, step.radius_in, size) ? 1 : 0;
        }
        state[t] = s;
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    /* The layer by itself first, then what is composed so far: loops that mix both run at half the speed on CPUs. Rows are
     * the outer loop, for the sake of what CPUs load ahead. */
    const int line_x0 = x0 - halo > 0 ? x0 - halo : 0;
    const int line_x1 = x0 + step.segment + halo < size.width ? x0 + step.segment + halo : size.width;
    const int span0 = line_x0 / LAYERED_SPAN, spans = (line_x1 + LAYERED_SPAN - 1) / LAYERED_SPAN - span0;
    for (int b = lid, i = 0; i < FIR_ROWS; b += items) {
        for (; b >= spans; b -= spans) i++;
        const int x = (span0 + b) * LAYERED_SPAN, tx = x / LAYERED_TILE;
        if (i >= FIR_ROWS || !(state[tx - tile0] & 2)) continue;
        const uint within = layered_within(x, line_x0, line_x1);
        floatn layer[LAYERED_BLOCKS][4];
        layered_span(layer, color, inv_depth, size, own, layer_peels[tx], y0 + i < size.height ? within : 0u, x, y0 + i);
        layered_put(lines + (x - x0 + halo) * FIR_LINE + 4 * i, layer, within);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int b = lid; b < line_width / PIXELS; b += items) {
        int x = x0 - halo + PIXELS * b;
        if (x < 0 || x >= size.width) continue;
        __local float *line = lines + PIXELS * b * FIR_LINE;
        const int is_there = state[x / LAYERED_TILE - tile0];
        if (is_there == 2 || (is_there == 3 && !step.in_front && layered_hides(line))) continue;
        for (int row = 0; row < FIR_ROWS; row += FIR_RUN) {
            floatn acc[FIR_RUN] = {(floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f)};
            if (is_there && y0 + row < size.height)
                fir_columns(acc, image, x, y0 + row, size.height, size.pitch, taps + step.taps_in, step.radius_in);
            layered_add(line + 4 * row, acc, is_there & 2, step.in_front);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    fir_extend_lines(lines, line_width, x0 - halo, size.width);
    /* Tiles that the row filter reads; beyond the image's edges the edge tiles stand for the rest. */
    for (int t = lid; t < segment_tiles; t += items) {
        const int tile = x0 / LAYERED_TILE + t;
        int any = 0;
        for (int i = 0; i <= 2 * halo_tiles; i++) any |= state[t + i];
        is_written[t] = any;
        if (tile < size.tiles_x) reached_out[ty * size.tiles_x + tile] = any;
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    for (int b = lid; b < step.segment / FIR_RUN * FIR_GROUPS; b += items) {
        int j = b / FIR_GROUPS * FIR_RUN, x = x0 + j, row = b % FIR_GROUPS * PIXELS;
        if (x >= size.pitch) continue;
        if (is_written[j / LAYERED_TILE]) {
            fir_store(out, lines + (j + halo) * FIR_LINE + 4 * row, x, y0 + row, size.height, size.pitch,
                      taps + step.taps_out, step.radius_out);
        } else {
            for (int i = 0; i < PIXELS && y0 + row + i < size.height; i++)
#pragma unroll
                for (int c = 0; c < 4 * FIR_RUN; c += LANES)
                    store_lanes(out + ((size_t)(y0 + row + i) * size.pitch + x) * 4 + c, (floatn)(0.0f));
        }
    }
}

/* Divide PIXELS pixels by coverage and store them at the place the guard band leaves; see LAYERED_ALPHA_RUN for what the
 * channels hold. */
static inline void layered_finish_pixels(__global float *out, floatn v, LayeredSize size, int guard, int x, int y)
{
    const int ox = x - guard, oy = y - guard;
    const int out_width = size.width - 2 * guard, out_height = size.height - 2 * guard;
    if (oy < 0 || oy >= out_height || ox <= -PIXELS || ox >= out_width) return;
    floatp coverage = v.ALPHA;
    floatp scale = coverage > LAYERED_MIN_COVERAGE ? 1.0f / coverage : (floatp)(0.0f);
    v = v * spread(scale);
    v = v > 0.0f ? v : (floatn)(0.0f); /* "over" takes a rounding from what is behind coverage of 1 and a rounding */
    __global float *to = out + ((long)oy * out_width + ox) * 4;
#if LAYERED_ALPHA_RUN
#pragma unroll
    for (int i = 0; i < PIXELS; i++) {
        const float alpha = pixel_of(v, i).x;
        if (ox + i >= 0 && ox + i < out_width) to[4 * i + 3] = alpha > 1.0f ? 1.0f : alpha;
    }
#else
    v.ALPHA = scale > 0.0f ? (floatp)(1.0f) : (floatp)(0.0f);
    if (ox >= 0 && ox + PIXELS <= out_width) {
        store_lanes(to, v);
    } else {
        for (int i = 0; i < PIXELS; i++)
            if (ox + i >= 0 && ox + i < out_width) store_pixel(to + 4 * i, pixel_of(v, i));
    }
#endif
}

typedef struct {
    int layer;                   /* the one in focus */
    int front, back;             /* as `below` in LayeredStep */
    int radius_front, taps_front;
    int radius_back, taps_back;
    int guard;
} LayeredResolve;

/* layered_resolve: front over the layer in focus over back, divided by coverage (eq. 12, section 3.3.1).
 * reads   front, back  float[height][pitch][4]  blurred along the rows, the column filter still owed
 *         front_reached, back_reached  int[tiles_y][tiles_x]
 *         color, inv_depth, tile_peels, taps, matting  as layered_step
 * writes  out  float[height - 2*guard][width - 2*guard][4]
 * range   2-D groups: one per tile; local size (any, 1)
 * local   lines  float[LAYERED_TILE][FIR_LINE] */
__kernel void layered_resolve(__global float *restrict out, const __global float *restrict front,
                              const __global int *restrict front_reached, const __global float *restrict back,
                              const __global int *restrict back_reached, const __global float *restrict color,
                              const __global float *restrict inv_depth, const __global uint *restrict tile_peels,
                              const __global float *restrict taps, const __global LayeredMatting *restrict matting,
                              LayeredSize size, LayeredResolve resolve, __local float *restrict lines)
{
    const int lid = get_local_id(0), items = get_local_size(0);
    const int tx = get_group_id(0), ty = get_group_id(1);
    const int x0 = tx * LAYERED_TILE, y0 = ty * FIR_ROWS;
    const LayeredLayer own = layered_layer(matting, resolve.layer);
    const uint peels = tile_peels[((size_t)resolve.layer * size.tiles_y + ty) * size.tiles_x + tx];
    const int has_front = layered_is_reached(front_reached, resolve.front, tx, ty, resolve.radius_front, size);
    const int has_back = layered_is_reached(back_reached, resolve.back, tx, ty, resolve.radius_back, size);

    for (int b = lid; b < FIR_ROWS * LAYERED_TILE / LAYERED_SPAN; b += items) {
        int x = x0 + b % (LAYERED_TILE / LAYERED_SPAN) * LAYERED_SPAN, i = b / (LAYERED_TILE / LAYERED_SPAN);
        const uint within = layered_within(x, x0, size.width);
        floatn layer[LAYERED_BLOCKS][4];
        layered_span(layer, color, inv_depth, size, own, peels, y0 + i < size.height ? within : 0u, x, y0 + i);
        layered_put(lines + (x - x0) * FIR_LINE + 4 * i, layer, within);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int b = lid; b < LAYERED_TILE / PIXELS; b += items) {
        int x = x0 + PIXELS * b;
        if (x >= size.width) continue;
        __local float *line = lines + PIXELS * b * FIR_LINE;
        const int is_open = has_back && !layered_hides(line);
        for (int row = 0; row < FIR_ROWS && y0 + row < size.height; row += FIR_RUN, line += 4 * FIR_RUN) {
            floatn image[FIR_RUN], acc[FIR_RUN];
#pragma unroll
            for (int i = 0; i < FIR_RUN; i++) image[i] = load_lanes_local(line + fir_place(i));
            fir_turn(image);
            if (is_open) {
                fir_columns(acc, back, x, y0 + row, size.height, size.pitch, taps + resolve.taps_back,
                            resolve.radius_back);
#pragma unroll
                for (int i = 0; i < FIR_RUN; i++) image[i] = over(image[i], acc[i]);
            }
            if (has_front) {
                fir_columns(acc, front, x, y0 + row, size.height, size.pitch, taps + resolve.taps_front,
                            resolve.radius_front);
#pragma unroll
                for (int i = 0; i < FIR_RUN; i++) image[i] = over(acc[i], image[i]);
            }
#pragma unroll
            for (int i = 0; i < FIR_RUN; i++)
                if (y0 + row + i < size.height)
                    layered_finish_pixels(out, image[i], size, resolve.guard, x, y0 + row + i);
        }
    }
}

/* layered_under: put one whole blurred layer behind what is composed so far (the variant without cascade).
 * reads   image    float[height][pitch][4]  blurred along the rows, the column filter still owed
 *         taps     float[]
 * updates composed float[height][pitch][4]  written afresh when `first`
 * range   2-D, one item per PIXELS pixels of a row and FIR_RUN rows, any local size */
__kernel void layered_under(__global float *restrict composed, const __global float *restrict image,
                            const __global float *restrict taps, LayeredSize size, int first, int radius, int start)
{
    const int x = PIXELS * (int)get_global_id(0), y0 = FIR_RUN * (int)get_global_id(1);
    if (x >= size.width || y0 >= size.height) return;
    floatn acc[FIR_RUN];
    fir_columns(acc, image, x, y0, size.height, size.pitch, taps + start, radius);
#pragma unroll
    for (int i = 0; i < FIR_RUN; i++) {
        if (y0 + i >= size.height) continue;
        __global float *to = composed + ((size_t)(y0 + i) * size.pitch + x) * 4;
        store_lanes(to, first ? acc[i] : over(load_lanes(to), acc[i]));
    }
}

/* layered_finish: divide by coverage, crop the guard band.
 * reads   composed  float[height][pitch][4]
 * writes  out       float[height - 2*guard][width - 2*guard][4]
 * range   2-D, one item per PIXELS pixels of a row, any local size */
__kernel void layered_finish(__global float *restrict out, const __global float *restrict composed, LayeredSize size,
                             int guard)
{
    const int x = PIXELS * (int)get_global_id(0), y = get_global_id(1);
    if (x >= size.width || y >= size.height) return;
    layered_finish_pixels(out, load_lanes(composed + ((size_t)y * size.pitch + x) * 4), size, guard, x, y);
}
