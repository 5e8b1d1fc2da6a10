/* multiview.cl: rays through a layered image-based scene (Lee, Eisemann & Seidel 2009).
 *
 * The lens ray through pixel p and lens point v meets the signed CoC radius C at pixel p + C * (-v.x, v.y), y down: in
 * pixels and C rays are straight (eq. 3 of the paper). The frame's peels are split into layers of equal CoC growth
 * (eq. 4), so thin that a ray moves by less than a pixel inside one. There the height field needs no search, and all
 * 16 pixels of a run move by the same whole number of pixels: the way of 16 rays through a layer is one contiguous,
 * unaligned load. Gathers, which CPUs are slow at, do not occur. On its way from one pixel to the next a ray takes both
 * in for a short while, so that an image whose focus moves does not jump.
 *
 * Layer s holds the inverse depths between its bounds and is met in its middle, or at the mean C of what it holds. Its
 * bounds stand still in the scene while the focus moves, so that all that it holds is blurred more or less evenly. Layers
 * are float[height][pitch][4], premultiplied; alpha is how much of the pixel, or of the cone around it, the layer blocks.
 * Cells are MULTIVIEW_CELL x MULTIVIEW_CELL pixels; bit s of a cell's mask says that layer s has something there.
 *
 * Peels may have MULTIVIEW_SCALE times the pixels of the image along x and y. What is called fine below has the size of
 * the peels, everything else that of the image; C is in pixels of the image. */

#include "common.clh"

#define MULTIVIEW_CELL 16
#define MULTIVIEW_MAX_LAYERS 32
/* Farther in px, and nearer in 1/m, than anything: where slots with nothing in them stand. */
#define MULTIVIEW_NOWHERE 1e30f
/* Slots at least this opaque are taken for opaque. */
#define MULTIVIEW_OPAQUE 0.998f
/* What a column of peels may let through and still count as closed; as LayeredFrame.is_opaque has it. */
#define MULTIVIEW_CLOSED 1e-3f
/* Steps in px from one pixel to the next that belong to one surface. */
#define MULTIVIEW_CONNECTED 2.0f
/* How far a surface goes on behind a slot, in fine pixels: to the next pixel, and one more for windows of several. */
#define MULTIVIEW_GOES_ON (float)(MULTIVIEW_SCALE == 1 ? 1 : MULTIVIEW_SCALE + 1)
/* Below this share of rays that met something known, a pixel is what a pinhole sees. */
#define MULTIVIEW_LEAST 1e-4f
/* Light above this, blurred by a good deal, takes more rays: it shows them. */
#define MULTIVIEW_BRIGHT 1.5f

/* 1: the frame's image is not opaque. Layer `layers` of the stack then holds, in alpha, where the view goes past the
 * scene. */
#ifndef MULTIVIEW_VOID
#define MULTIVIEW_VOID 0
#endif
/* Pixels from one lane of a run to the next: 1, or 4 when pixels have 4 x 4 different sets of rays. */
#ifndef MULTIVIEW_STRIDE
#define MULTIVIEW_STRIDE 1
#endif
/* Pixels of a row that share the lists of their cells, and those that an item traces. */
#define MULTIVIEW_SPAN (16 * MULTIVIEW_STRIDE)
#define MULTIVIEW_AT_ONCE (LANES * MULTIVIEW_STRIDE)
/* 1: rays walk the peels themselves; there is no stack of layers but for the void. */
#ifndef MULTIVIEW_PEELED
#define MULTIVIEW_PEELED 0
#endif
/* With MULTIVIEW_PEELED: how often the way of a ray through a layer is halved around what it meets there. */
#ifndef MULTIVIEW_REFINE
#define MULTIVIEW_REFINE 0
#endif
/* 1: rays come in groups, each through layers of its own (shading_view), and are summed up in `parts`. */
#ifndef MULTIVIEW_PARTS
#define MULTIVIEW_PARTS 0
#endif
/* 1: rays are sent in the cells alone that are asked for. */
#ifndef MULTIVIEW_SPARSE
#define MULTIVIEW_SPARSE 0
#endif

/* Pixels of the peels for one of the image, along x and y. */
#ifndef MULTIVIEW_SCALE
#define MULTIVIEW_SCALE 1
#endif
/* Fine pixels that a cone may reach to either side, a multiple of 4, and pixels of a row that an item of the filter
 * makes. */
#define MULTIVIEW_HALO (16 * MULTIVIEW_SCALE)
#define MULTIVIEW_RUN 64

typedef struct {
    int width, height, pitch, peels, layers, cells_x, cells_y;
} MultiviewSize;

/* How inverse depth is cut, 1/m: layers of `fine` around `anchor` as far as `turn` to either side, then layers of
 * `coarse`. `number` of them, with a fraction, are nearer than `anchor`. */
typedef struct {
    float anchor, fine, coarse, turn, number;
} MultiviewSteps;

/* What depends on the lens of the frame, for each layer:
 *   bound    inverse depth where it begins, 1/m, falling; the first and the last layer have no end
 *   coc      C in its middle, px
 *   largest  the largest blur radius that it may be met at, px
 *   scale    of rays' moves; below 1 where the width of windows is part of the blur
 *   window   half the width of its cones, fine pixels
 *   haste    one over the way of a ray, px, on which it passes from one pixel to the next
 *   reach    fine cells that its rays and cones may move to either side
 *   needs    number of the set of rays that its blur takes, and 256 times that for bright light in it */
typedef struct {
    float bound[MULTIVIEW_MAX_LAYERS + 1], coc[MULTIVIEW_MAX_LAYERS], largest[MULTIVIEW_MAX_LAYERS];
    float scale[MULTIVIEW_MAX_LAYERS], window[MULTIVIEW_MAX_LAYERS], haste[MULTIVIEW_MAX_LAYERS];
    int reach[MULTIVIEW_MAX_LAYERS], needs[MULTIVIEW_MAX_LAYERS];
} MultiviewPlaces;

/* Where a ray meets a layer, px right and down from its pixel: in a whole one, and for so great a share also in the next
 * one to either side; the share is below 0 where that is the left or the upper one, and 0.5 at most. */
typedef struct {
    int x, y;
    float to_x, to_y;
} MultiviewShift;

/* Layers between the near end of the first layer and an inverse depth, with a fraction. */
static inline floatn layer_at(floatn w, MultiviewSteps steps)
{
    floatn c = steps.anchor - w, away = c < 0.0f ? -c : c;
    floatn near = away < steps.turn ? away : (floatn)(steps.turn);
    floatn n = near / steps.fine + (away - near) / steps.coarse;
    return (c < 0.0f ? -n : n) + steps.number;
}

/* The inverse depths of a layer: at most x, above y. Empty slots are outside of all. */
static inline float2 ends_of(const __global MultiviewPlaces *places, int s, int layers)
{
    return (float2)(s > 0 ? places->bound[s] : MULTIVIEW_NOWHERE, s + 1 < layers ? places->bound[s + 1] : -0.5f);
}

/* How far a surface goes on behind a slot on its way to the next pixel, in 1/m: the lesser step of both sides, so that a
 * silhouette does not count, and nothing where neither side is connected or the slot sticks out from both: a lone pixel
 * just before a surface is no slope. `c1` px of C is one 1/m. */
static inline floatn step_of(floatn w, floatn a, floatn b, float c1)
{
    const floatn to_a = w > a ? w - a : a - w, to_b = w > b ? w - b : b - w;
    const floatn px_a = a < 0.0f ? (floatn)(MULTIVIEW_NOWHERE) : to_a * (c1 < 0.0f ? -c1 : c1);
    const floatn px_b = b < 0.0f ? (floatn)(MULTIVIEW_NOWHERE) : to_b * (c1 < 0.0f ? -c1 : c1);
    const floatn least = px_a < px_b ? to_a : to_b;
    const intn a_joins = px_a <= MULTIVIEW_CONNECTED, b_joins = px_b <= MULTIVIEW_CONNECTED;
    const intn sticks_out = a_joins & b_joins & ((w - a) * (w - b) > 0.0f);
    return (a_joins | b_joins) & ~sticks_out ? least : (floatn)(0.0f);
}

/* multiview_place: keeps what depends on the lens where all passes of the frame find it.
 * writes  places  MultiviewPlaces
 * range   1-D, one item */
__kernel void multiview_place(__global MultiviewPlaces *restrict places, MultiviewPlaces given)
{
    if (get_global_id(0) == 0) *places = given;
}

/* multiview_extent: the far end of every slot. A slot is a column from its own depth to there, so that no ray slips
 * between the pixels of a slope.
 * source  takes the place of the fixed 10 % overlap of layers, section 4.2
 * reads   inv_depth  float[peels][height][pitch]  1/m
 * writes  extent     float[peels][height][pitch]  1/m; MULTIVIEW_NOWHERE where nothing is
 * range   3-D, one item per LANES fine pixels of a row of a peel, any local size */
__kernel void multiview_extent(__global float *restrict extent, const __global float *restrict inv_depth,
                               MultiviewSize size, float c1)
{
    const int x = LANES * (int)get_global_id(0), y = get_global_id(1), m = get_global_id(2);
    if (x >= size.pitch || y >= size.height || m >= size.peels) return;
    const size_t at = ((size_t)m * size.height + y) * size.pitch + x;
    const __global float *inv = inv_depth + at;
    const floatn none = (floatn)(-1.0f);
    floatn w = load_lanes(inv);
    /* The ends of a row stand for their own neighbours. */
    floatn left = x > 0 ? load_lanes(inv - 1) : lanes_after(-1.0f, w);
    floatn right = x + LANES < size.pitch ? load_lanes(inv + 1) : lanes_before(w, -1.0f);
    floatn above = y > 0 ? load_lanes(inv - size.pitch) : none;
    floatn below = y + 1 < size.height ? load_lanes(inv + size.pitch) : none;
    floatn end = w - MULTIVIEW_GOES_ON * (step_of(w, left, right, c1) + step_of(w, above, below, c1));
    store_lanes(extent + at, w < 0.0f ? (floatn)(MULTIVIEW_NOWHERE) : end);
}

/* multiview_cells: which layers have something in a cell; the first level of the N-buffer.
 * A slot close to the bound of two layers counts for both: a mask may say too much, never too little.
 * reads   inv_depth  float[peels][height][pitch]  1/m
 *         extent     float[peels][height][pitch]  1/m
 * writes  nbuffer    uint[0][cells_y][cells_x]    bit s: layer s
 * range   2-D, one item per cell, any local size */
__kernel void multiview_cells(__global uint *restrict nbuffer, const __global float *restrict inv_depth,
                              const __global float *restrict extent, MultiviewSize size, MultiviewSteps steps)
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= size.cells_x || cy >= size.cells_y) return;
    const int y_end = (cy + 1) * MULTIVIEW_CELL < size.height ? (cy + 1) * MULTIVIEW_CELL : size.height;
    const float last = (float)(size.layers - 1);
    uintn mask = (uintn)(0u);
    for (int m = 0; m < size.peels; m++)
        for (int y = cy * MULTIVIEW_CELL; y < y_end; y++) {
            const size_t row = ((size_t)m * size.height + y) * size.pitch;
            for (int x = cx * MULTIVIEW_CELL; x < (cx + 1) * MULTIVIEW_CELL; x += LANES) {
                floatn w = load_lanes(inv_depth + row + x);
                floatn from = layer_at(w, steps) - 1e-3f;
                floatn to = layer_at(load_lanes(extent + row + x), steps) + 1e-3f;
                from = from < 0.0f ? (floatn)(0.0f) : from;
                from = from > last ? (floatn)(last) : from;
                to = to > last ? (floatn)(last) : to;
                to = to < from ? from : to;
                uintn bits = ((uintn)(2u) << to_uintn(to)) - ((uintn)(1u) << to_uintn(from));
                mask |= w < 0.0f ? (uintn)(0u) : bits;
            }
        }
    nbuffer[cy * size.cells_x + cx] = or_lanes(mask);
}

/* multiview_nbuffer: one more level of the N-buffer: a cell holds what is in the 2^level x 2^level cells from it on.
 * source  Decoret 2005; minima over single bits, all layers at once, are unions of masks
 * reads, writes  nbuffer  uint[levels][cells_y][cells_x]  reads level - 1, writes level
 * range   2-D, one item per cell, any local size */
__kernel void multiview_nbuffer(__global uint *nbuffer, MultiviewSize size, int level)
{
    const int cx = get_global_id(0), cy = get_global_id(1), step = 1 << (level - 1);
    if (cx >= size.cells_x || cy >= size.cells_y) return;
    const size_t plane = (size_t)size.cells_x * size.cells_y;
    const int right = cx + step < size.cells_x, down = cy + step < size.cells_y;
    const __global uint *at = nbuffer + (level - 1) * plane + cy * size.cells_x + cx;
    uint mask = at[0];
    if (right) mask |= at[step];
    if (down) mask |= at[step * size.cells_x];
    if (right && down) mask |= at[step * size.cells_x + step];
    nbuffer[level * plane + cy * size.cells_x + cx] = mask;
}

/* What is in the fine cells from (x0, y0) to (x1, y1), cut by the frame: four squares of the N-buffer, or more where the
 * frame cuts the window into a long one. */
static inline uint masks_in(const __global uint *nbuffer, MultiviewSize fine, int levels, int x0, int y0, int x1, int y1)
{
    const size_t plane = (size_t)fine.cells_x * fine.cells_y;
    x0 = clamp_index(x0, fine.cells_x - 1), x1 = clamp_index(x1, fine.cells_x - 1);
    y0 = clamp_index(y0, fine.cells_y - 1), y1 = clamp_index(y1, fine.cells_y - 1);
    const int across = x1 - x0 + 1, down = y1 - y0 + 1, side = across < down ? across : down;
    int n = 0;
    while (n + 1 < levels && 2 << n <= side) n++;
    const int last_x = x1 + 1 - (1 << n), last_y = y1 + 1 - (1 << n);
    uint mask = 0u;
    for (int y = y0;; y = y + (1 << n) < last_y ? y + (1 << n) : last_y) {
        for (int x = x0;; x = x + (1 << n) < last_x ? x + (1 << n) : last_x) {
            mask |= nbuffer[n * plane + y * fine.cells_x + x];
            if (x == last_x) break;
        }
        if (y == last_y) return mask;
    }
}

/* multiview_wanted: which layers any ray may look at in a cell. The others need not be filled there, not even with
 * nothing: in a frame that is mostly in focus that is most of the work.
 * reads   nbuffer  uint[levels][fine cells_y][cells_x]
 *         places   MultiviewPlaces
 * writes  wanted   uint[cells_y][cells_x]  bit s: layer s
 * range   2-D, one item per cell, any local size */
__kernel void multiview_wanted(__global uint *restrict wanted, const __global uint *restrict nbuffer,
                               const __global MultiviewPlaces *restrict places, MultiviewSize fine, MultiviewSize size,
                               int levels, int cull)
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= size.cells_x || cy >= size.cells_y) return;
    uint list = 0u;
    for (int s = 0; s < size.layers; s++) {
        /* A pixel within reach of something looks as far again; runs share the lists of their cells. */
        const int r = 2 * places->reach[s] + MULTIVIEW_STRIDE * MULTIVIEW_SCALE;
        const int x = cx * MULTIVIEW_SCALE, y = cy * MULTIVIEW_SCALE, last = MULTIVIEW_SCALE - 1;
        list |= masks_in(nbuffer, fine, levels, x - r, y - r, x + last + r, y + last + r) & 1u << s;
    }
    wanted[cy * size.cells_x + cx] = cull ? list : ~0u;
}

/* multiview_centres: the C at which rays meet each layer: the mean over what it holds, bright things first, since their
 * discs show it most.
 * reads   moments  float4[layers][fine cells_y][cells_x]  as multiview_split writes them
 *         nbuffer  uint[0][fine cells_y][cells_x]
 *         places   MultiviewPlaces
 * writes  coc      float[layers]  px
 * scalars the mean counts from a blur of `least` px on, in full from `full` px on: nearer to the focus, and for layers
 *         with nothing of their own, it is the middle
 * range   1-D, one item per layer, any local size */
__kernel void multiview_centres(__global float *restrict coc, const __global float4 *restrict moments,
                                const __global uint *restrict nbuffer,
                                const __global MultiviewPlaces *restrict places, MultiviewSize fine, float least,
                                float full)
{
    const int s = get_global_id(0), cells = fine.cells_x * fine.cells_y;
    if (s >= fine.layers) return;
    float total = 0.0f, weight = 0.0f;
    for (int i = 0; i < cells; i++)
        if (nbuffer[i] >> s & 1u) {
            total += moments[s * cells + i].x;
            weight += moments[s * cells + i].y;
        }
    const float middle = places->coc[s], away = middle < 0.0f ? -middle : middle;
    const float share = away >= full ? 1.0f : away < least ? 0.0f : (away - least) / (full - least);
    coc[s] = share > 0.0f && weight > 0.0f ? middle + share * (total / weight - middle) : middle;
}

/* How much of the next pixel a ray takes in that has gone `past` the middle of its own, up to half a pixel. */
static inline float next_share(float past, float haste)
{
    const float share = 0.5f - (0.5f - (past < 0.0f ? -past : past)) * haste;
    return share <= 0.0f ? 0.0f : past < 0.0f ? -share : share;
}

/* multiview_shifts: how many pixels each ray has moved at each layer.
 * reads   points  float2[rays]    on the lens, right and down, in units of its radius
 *         coc     float[layers]   px
 *         places  MultiviewPlaces
 * writes  shifts  MultiviewShift[rays][layers]
 * range   2-D, one item per layer and ray, any local size */
__kernel void multiview_shifts(__global MultiviewShift *restrict shifts, const __global float2 *restrict points,
                               const __global float *restrict coc, const __global MultiviewPlaces *restrict places,
                               int layers, int rays)
{
    const int s = get_global_id(0), i = get_global_id(1);
    if (s >= layers || i >= rays) return;
    const float2 to = points[i] * (places->scale[s] * coc[s]);
    const int2 by = convert_int2_rtn(to + 0.5f);
    const float2 past = to - convert_float2(by);
    const float haste = places->haste[s];
    const MultiviewShift shift = {by.x, by.y, next_share(past.x, haste), next_share(past.y, haste)};
    shifts[i * layers + s] = shift;
}

/* multiview_bright: which layers have light in a cell that a disc of blur shows; the first level of an N-buffer.
 * reads   moments  float4[layers][fine cells_y][cells_x]
 *         nbuffer  uint[0][fine cells_y][cells_x]
 * writes  bright   uint[0][fine cells_y][cells_x]
 * range   2-D, one item per fine cell, any local size */
__kernel void multiview_bright(__global uint *restrict bright, const __global float4 *restrict moments,
                               const __global uint *restrict nbuffer, MultiviewSize fine)
{
    const int cx = get_global_id(0), cy = get_global_id(1), at = cy * fine.cells_x + cx;
    if (cx >= fine.cells_x || cy >= fine.cells_y) return;
    uint mask = 0u;
    for (uint left = nbuffer[at]; left != 0u; left &= left - 1u) {
        int s = 0;
        while (!(left >> s & 1u)) s++;
        if (moments[s * fine.cells_x * fine.cells_y + at].z > MULTIVIEW_BRIGHT) mask |= 1u << s;
    }
    bright[at] = mask;
}

/* multiview_lists: the layers that any ray through a cell can meet, and how many rays that takes.
 * reads   nbuffer  uint[levels][fine cells_y][cells_x]
 *         bright   uint[levels][fine cells_y][cells_x]
 *         coc      float[layers]  px
 *         places   MultiviewPlaces
 * writes  lists    uint[cells_y][cells_x]  bit s: layer s
 *         sets     int[cells_y][cells_x]   set of rays
 * scalars the farthest ray moves `farthest` px per px of C; where that comes to less than `still`, one ray says all
 * range   2-D, one item per cell, any local size */
__kernel void multiview_lists(__global uint *restrict lists, __global int *restrict sets,
                              const __global uint *restrict nbuffer, const __global uint *restrict bright,
                              const __global float *restrict coc, const __global MultiviewPlaces *restrict places,
                              MultiviewSize fine, MultiviewSize size, int levels, int cull, float farthest, float still)
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= size.cells_x || cy >= size.cells_y) return;
    uint list = 0u;
    int set = 0;
    for (int s = 0; s < size.layers; s++) {
        const int reach = places->reach[s];
        const int x0 = cx * MULTIVIEW_SCALE - reach, x1 = (cx + 1) * MULTIVIEW_SCALE - 1 + reach;
        const int y0 = cy * MULTIVIEW_SCALE - reach, y1 = (cy + 1) * MULTIVIEW_SCALE - 1 + reach;
        if (!(masks_in(nbuffer, fine, levels, x0, y0, x1, y1) >> s & 1u)) continue;
        list |= 1u << s;
        /* A search looks at a layer from end to end. */
        const float blur = MULTIVIEW_REFINE ? places->largest[s] : coc[s] < 0.0f ? -coc[s] : coc[s];
        if (blur * (places->scale[s] * farthest) < still) continue;
        const int is_bright = masks_in(bright, fine, levels, x0, y0, x1, y1) >> s & 1u;
        const int need = is_bright ? places->needs[s] >> 8 : places->needs[s] & 255;
        set = set > need ? set : need;
    }
    lists[cy * size.cells_x + cx] = cull ? list : ~0u >> (MULTIVIEW_MAX_LAYERS - size.layers);
    sets[cy * size.cells_x + cx] = set;
}

/* Over the values of a floatp. */
static inline float sum_part(floatp v)
{
#if LANES == 16
    return (v.x + v.y) + (v.z + v.w);
#elif LANES == 8
    return v.x + v.y;
#else
    return v;
#endif
}

static inline float greatest_of_part(floatp v)
{
#if LANES == 16
    const float2 two = v.lo < v.hi ? v.hi : v.lo;
    return two.x < two.y ? two.y : two.x;
#elif LANES == 8
    return v.x < v.y ? v.y : v.x;
#else
    return v;
#endif
}

/* multiview_split: one layer, the nearest slots inside it; several peels of glass one over the other.
 * source  eq. 4; exact where the paper's single pass may lose fragments of triangles that cross a bound
 * reads   color      float[peels][fine height][width][4]
 *         inv_depth  float[peels][fine height][pitch]  1/m
 *         extent     float[peels][fine height][pitch]  1/m
 *         nbuffer    uint[0][fine cells_y][cells_x]
 *         wanted     uint[cells_y][cells_x]
 *         places     MultiviewPlaces
 * writes  layers     float[slot][fine height][pitch][4]  not with MULTIVIEW_PEELED
 *         moments    float4[layers][fine cells_y][cells_x]  sums of weighted C and of weights, most light; where the
 *                    layer has something
 * range   2-D, one item per fine cell, any local size */
__kernel void multiview_split(
#if !MULTIVIEW_PEELED
                              __global float *restrict layers,
#endif
                              __global float4 *moments, const __global float *restrict color, const __global float *restrict inv_depth,
                              const __global float *restrict extent, const __global uint *restrict nbuffer,
                              const __global uint *restrict wanted, const __global MultiviewPlaces *restrict places,
                              MultiviewSize fine, int wanted_x, float c1, float c0, int layer, int slot)
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= fine.cells_x || cy >= fine.cells_y) return;
    if (!(wanted[cy / MULTIVIEW_SCALE * wanted_x + cx / MULTIVIEW_SCALE] >> layer & 1u)) return;
    const int y_end = (cy + 1) * MULTIVIEW_CELL < fine.height ? (cy + 1) * MULTIVIEW_CELL : fine.height;
    const int peels = nbuffer[cy * fine.cells_x + cx] >> layer & 1u ? fine.peels : 0;
    const float2 ends = ends_of(places, layer, fine.layers);
    floatp total = (floatp)(0.0f), weights = (floatp)(0.0f), most = (floatp)(0.0f);
    for (int i = 0; i < (y_end - cy * MULTIVIEW_CELL) * (MULTIVIEW_CELL / LANES); i++) {
        const int x = cx * MULTIVIEW_CELL + i % (MULTIVIEW_CELL / LANES) * LANES;
        const int y = cy * MULTIVIEW_CELL + i / (MULTIVIEW_CELL / LANES);
        floatn quad[4] = {(floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f)};
        for (int m = 0; m < peels; m++) {
            const size_t row = (size_t)m * fine.height + y;
            floatn w = load_lanes(inv_depth + row * fine.pitch + x), c = w * c1 + c0;
            floatn end = load_lanes(extent + row * fine.pitch + x);
            floatn in = w > ends.y && end <= ends.x ? (floatn)(1.0f) : (floatn)(0.0f);
            if (sum_lanes(in) == 0.0f) continue;
            floatn own = w <= ends.x ? in : (floatn)(0.0f);
            const __global float *rgba = color + (row * fine.width + x) * 4;
            const floatp ins[4] = FOUR_PARTS(in);
            const floatp owns[4] = FOUR_PARTS(own);
            const floatp cs[4] = FOUR_PARTS(c);
#pragma unroll
            for (int q = 0; q < 4; q++) {
                const int valid = fine.width - x - PIXELS * q;
                if (valid <= 0) continue;
                floatn v = load_pixels(rgba + LANES * q, valid);
                floatp seen = 1.0f - quad[q].ALPHA, light = v.RED;
                light = light < v.GREEN ? v.GREEN : light;
                light = light < v.BLUE ? v.BLUE : light;
                floatp pull = (light * light + 0.01f * v.ALPHA) * seen * owns[q];
                /* An opaque slot may be met twice, glass must not. */
                floatp weight = v.ALPHA >= MULTIVIEW_OPAQUE ? ins[q] : owns[q];
                quad[q] += v * spread(seen * weight);
                total += owns[q] > 0.0f ? pull * cs[q] : (floatp)(0.0f);
                weights += pull;
                light *= seen * owns[q];
                most = most < light ? light : most;
            }
        }
#if !MULTIVIEW_PEELED
        __global float *out = layers + (((size_t)slot * fine.height + y) * fine.pitch + x) * 4;
#pragma unroll
        for (int q = 0; q < 4; q++) store_lanes(out + LANES * q, quad[q]);
#endif
    }
    moments[((size_t)layer * fine.cells_y + cy) * fine.cells_x + cx] =
        (float4)(sum_part(total), sum_part(weights), greatest_of_part(most), 0.0f);
}

/* multiview_past: where the void is seen past everything in a frame that is not opaque: in columns of peels that let
 * light through, and behind those that end before the last peel, since nothing else can be there.
 * reads   color   float[peels][fine height][width][4]
 * writes  layers  float[slot][height][pitch][4]  (0, 0, 0, 1) where the void is known to be, else 0; or a part of that
 * range   2-D, one item per row: (1, height), any local size */
__kernel void multiview_past(__global float *restrict layers, const __global float *restrict color, MultiviewSize size,
                             int slot)
{
    const int y = get_global_id(1);
    if (y >= size.height) return;
    __global float *out = layers + ((size_t)slot * size.height + y) * size.pitch * 4;
    const size_t width = (size_t)size.width * MULTIVIEW_SCALE, height = (size_t)size.height * MULTIVIEW_SCALE;
    for (int x = 0; x < size.pitch; x++) {
        float past = 0.0f;
        for (int i = 0; i < (x < size.width ? MULTIVIEW_SCALE * MULTIVIEW_SCALE : 0); i++) {
            const size_t from_x = x * MULTIVIEW_SCALE + i % MULTIVIEW_SCALE;
            const size_t from_y = y * MULTIVIEW_SCALE + i / MULTIVIEW_SCALE;
            float through = 1.0f, alpha = 1.0f;
            for (int m = 0; m < size.peels; m++) {
                alpha = color[((m * height + from_y) * width + from_x) * 4 + 3];
                through *= 1.0f - alpha;
            }
            past += through > MULTIVIEW_CLOSED || alpha == 0.0f ? 1.0f : 0.0f;
        }
        past *= 1.0f / (MULTIVIEW_SCALE * MULTIVIEW_SCALE);
        store_pixel(out + 4 * x, (float4)(0.0f, 0.0f, 0.0f, past));
    }
}

#define MULTIVIEW_PIXEL(i) p[i]

/* multiview_cone: one layer as cones see it: the mean over a square window as wide as the cone is there.
 * source  section 4.4. All cones of a layer have the same width there, so that full-size means take the place of mip
 *         levels: no steps between levels, and still one look-up a ray
 * reads   image    float[fine height][pitch][4]
 *         nbuffer  uint[0][fine cells_y][cells_x]
 *         wanted   uint[cells_y][cells_x]
 *         places   MultiviewPlaces
 * writes  layers   float[slot][height][pitch][4]
 * range   2-D, one item per MULTIVIEW_RUN x MULTIVIEW_CELL pixels, any local size */
__kernel void multiview_cone(__global float *restrict layers, const __global float *restrict image,
                             const __global uint *restrict nbuffer, const __global uint *restrict wanted,
                             const __global MultiviewPlaces *restrict places, MultiviewSize fine, MultiviewSize size,
                             int layer, int slot)
{
    const int x0 = MULTIVIEW_RUN * (int)get_global_id(0), cy = get_global_id(1);
    if (x0 >= size.pitch || cy >= size.cells_y) return;
    const int y_end = (cy + 1) * MULTIVIEW_CELL < size.height ? (cy + 1) * MULTIVIEW_CELL : size.height;
    const int x1 = x0 + MULTIVIEW_RUN < size.pitch ? x0 + MULTIVIEW_RUN : size.pitch;
    /* `taps` whole fine pixels from `first` on, counted from the pixel's first one, and `edge` of one more at either
     * side. Fine pixels stand around the middle of the pixel: one at 0, or two half of one away. */
    const int is_odd = MULTIVIEW_SCALE % 2;
    const float half_width = places->window[layer] - 0.5f * (float)is_odd;
    const int whole = half_width < 1.0f ? 1 - is_odd : (int)half_width;
    const int first = (MULTIVIEW_SCALE - is_odd) / 2 - whole, taps = 2 * whole + is_odd;
    const float rest = half_width - (float)whole, edge = rest < 0.0f ? 0.0f : rest;
    const float scale = 1.0f / ((float)taps + 2.0f * edge);
    uint wants = 0u, around = 0u;
    for (int i = x0 / MULTIVIEW_CELL; i < (x0 + MULTIVIEW_RUN) / MULTIVIEW_CELL && i < size.cells_x; i++)
        wants |= wanted[cy * size.cells_x + i];
    if (!(wants >> layer & 1u)) return;
    const int margin = MULTIVIEW_HALO / MULTIVIEW_CELL, cell_y = cy * MULTIVIEW_SCALE;
    const int cell_x = x0 / MULTIVIEW_CELL * MULTIVIEW_SCALE;
    for (int j = cell_y - margin; j < cell_y + MULTIVIEW_SCALE + margin; j++)
        for (int i = cell_x - margin; i < cell_x + MULTIVIEW_SCALE * MULTIVIEW_RUN / MULTIVIEW_CELL + margin; i++)
            if (i >= 0 && j >= 0 && i < fine.cells_x && j < fine.cells_y) around |= nbuffer[j * fine.cells_x + i];
    const int is_empty = !(around >> layer & 1u);
    float line[(MULTIVIEW_SCALE * MULTIVIEW_RUN + 2 * MULTIVIEW_HALO) * 4];
    for (int y = cy * MULTIVIEW_CELL; y < y_end; y++) {
        __global float *out = layers + ((size_t)slot * size.height + y) * size.pitch * 4;
        if (is_empty) {
            for (int x = x0; x < x1; x += PIXELS) store_lanes(out + x * 4, (floatn)(0.0f));
            continue;
        }
        const int start = x0 * MULTIVIEW_SCALE - MULTIVIEW_HALO;
        for (int j = 0; j < MULTIVIEW_SCALE * MULTIVIEW_RUN + 2 * MULTIVIEW_HALO; j += PIXELS) {
            const int x = start + j;
            floatn sum = (floatn)(0.0f);
            if (x >= 0 && x < fine.pitch)
                for (int t = -1; t <= taps; t++) {
                    const int from = clamp_index(y * MULTIVIEW_SCALE + first + t, fine.height - 1);
                    const float weight = t < 0 || t == taps ? edge : 1.0f;
                    sum += (weight * scale) * load_lanes(image + ((size_t)from * fine.pitch + x) * 4);
                }
            store_lanes_private(line + 4 * j, sum);
        }
        /* Beyond the frame its edge goes on. */
        for (int j = 0; j < MULTIVIEW_SCALE * MULTIVIEW_RUN + 2 * MULTIVIEW_HALO; j++) {
            const int x = start + j, inside = clamp_index(x, fine.width - 1);
            if (x != inside)
                for (int c = 0; c < 4; c++) line[4 * j + c] = line[4 * (inside - start) + c];
        }
        for (int x = x0; x < x1; x += PIXELS) {
            const float *at = line + 4 * (MULTIVIEW_HALO + (x - x0) * MULTIVIEW_SCALE + first);
#if MULTIVIEW_SCALE == 1
            floatn sum = edge * (load_lanes_private(at - 4) + load_lanes_private(at + 4 * taps));
            for (int t = 0; t < taps; t++) sum += load_lanes_private(at + 4 * t);
#else
            float4 p[PIXELS];
            for (int j = 0; j < PIXELS; j++, at += 4 * MULTIVIEW_SCALE) {
                p[j] = edge * (*(const float4_unaligned *)(at - 4) + *(const float4_unaligned *)(at + 4 * taps));
                for (int t = 0; t < taps; t++) p[j] += *(const float4_unaligned *)(at + 4 * t);
            }
            floatn sum = PIXELS_OF(MULTIVIEW_PIXEL);
#endif
            store_lanes(out + x * 4, sum * scale);
        }
    }
}

/* Four pixels of a layer, MULTIVIEW_STRIDE apart. */
static inline floatn layer_quad(const __global float *p)
{
#if MULTIVIEW_STRIDE == 1
    return load_lanes(p);
#else
#define MULTIVIEW_EVERY(i) load_pixel(p + 4 * (i) * MULTIVIEW_STRIDE)
    return PIXELS_OF(MULTIVIEW_EVERY);
#undef MULTIVIEW_EVERY
#endif
}

/* The same at pixel x of a row, where some of them may lie outside of the frame. There its edge goes on, but of unknown
 * colour: rays that meet it are dropped. What is outside has a negative alpha. */
static inline floatn edge_quad(const __global float *row, int x, int is_outside, int width)
{
    float4 p[PIXELS];
    for (int j = 0; j < PIXELS; j++) {
        const int at = x + j * MULTIVIEW_STRIDE, inside = clamp_index(at, width - 1);
        p[j] = load_pixel(row + 4 * inside);
        p[j] = at != inside || is_outside ? (float4)(0.0f, 0.0f, 0.0f, -p[j].w) : p[j];
    }
    return PIXELS_OF(MULTIVIEW_PIXEL);
}

#if MULTIVIEW_PEELED
/* One value of each pixel of a run; beyond the frame its edge goes on. */
static inline floatn run_of(const __global float *row, int x, int is_inside, int width)
{
#if MULTIVIEW_STRIDE == 1
    if (is_inside) return load_lanes(row + x);
#endif
    float v[LANES];
    for (int j = 0; j < LANES; j++) v[j] = row[clamp_index(x + j * MULTIVIEW_STRIDE, width - 1)];
    return load_lanes_private(v);
}

/* What multiview_split would have put into a layer for 16 pixels, straight from the peels. */
static inline void peeled_quads(floatn quad[4], const __global float *color, const __global float *inv_depth,
                                const __global float *extent, MultiviewSize size, float2 ends, int x, int row,
                                int is_inside, int is_outside)
{
    for (int q = 0; q < 4; q++) quad[q] = (floatn)(0.0f);
    for (int m = 0; m < size.peels; m++) {
        const size_t line = (size_t)m * size.height + row;
        floatn end = run_of(extent + line * size.pitch, x, is_inside, size.width);
        floatn near = run_of(inv_depth + line * size.pitch, x, is_inside, size.width);
        floatn in = near > ends.y && end <= ends.x ? (floatn)(1.0f) : (floatn)(0.0f);
        if (sum_lanes(in) == 0.0f) continue;
        floatn own = near <= ends.x ? in : (floatn)(0.0f);
        const __global float *rgba = color + line * size.width * 4;
        const floatp ins[4] = FOUR_PARTS(in);
        const floatp owns[4] = FOUR_PARTS(own);
        for (int q = 0; q < 4; q++) {
            const int at = x + PIXELS * q * MULTIVIEW_STRIDE;
            floatn v = is_inside ? layer_quad(rgba + at * 4) : edge_quad(rgba, at, is_outside, size.width);
            floatp alpha = v.ALPHA < 0.0f ? -v.ALPHA : v.ALPHA;
            floatp weight = alpha >= MULTIVIEW_OPAQUE ? ins[q] : owns[q];
            floatp covered = quad[q].ALPHA < 0.0f ? -quad[q].ALPHA : quad[q].ALPHA;
            quad[q] += v * spread((1.0f - covered) * weight);
        }
    }
}
#endif

#if MULTIVIEW_PEELED && MULTIVIEW_REFINE
/* C of the first slot with something between two C, for each pixel of a run; MULTIVIEW_NOWHERE where there is none. */
static inline floatn first_between(const __global float *inv_depth, const __global float *extent, MultiviewSize size,
                                    float c1, float c0, float2 ends, int x, int row, int is_inside)
{
    floatn first = (floatn)(MULTIVIEW_NOWHERE);
    for (int m = 0; m < size.peels; m++) {
        const size_t line = ((size_t)m * size.height + row) * size.pitch;
        floatn near = run_of(inv_depth + line, x, is_inside, size.width);
        floatn end = run_of(extent + line, x, is_inside, size.width);
        near = near > ends.y && end <= ends.x ? near * c1 + c0 : (floatn)(MULTIVIEW_NOWHERE);
        first = near < first ? near : first;
    }
    return first;
}

/* Binary search: the ray of each pixel of a run through a layer, which it meets in the middle first. Where that shows
 * something between the layer's bounds, the half before or behind the middle is halved in turn. All rays of a run are
 * parallel: those in the same part of the layer have moved by the same whole number of pixels, and each part that some
 * of them are in is one contiguous look-up. */
static inline void refined_quads(floatn quad[4], const __global float *color, const __global float *inv_depth,
                                 const __global float *extent, MultiviewSize size, float c1, float c0, float2 ends,
                                 float2 limits, float2 point, int x0, int y)
{
    for (int q = 0; q < 4; q++) quad[q] = (floatn)(0.0f);
    floatn part = (floatn)(0.0f);
    for (int level = 0; level <= MULTIVIEW_REFINE; level++) {
        const float length = (limits.y - limits.x) / (float)(1 << level);
        floatn next = (floatn)(-1.0f);
        for (int k = 0; k < 1 << level; k++) {
            floatn is_here = part == (float)k ? (floatn)(1.0f) : (floatn)(0.0f);
            if (sum_lanes(is_here) == 0.0f) continue;
            const float c = limits.x + ((float)k + 0.5f) * length;
            const int2 by = convert_int2_rtn(point * c + 0.5f);
            const int x = x0 + by.x, row = clamp_index(y + by.y, size.height - 1);
            const int is_inside = x >= 0 && x + MULTIVIEW_AT_ONCE <= size.width && row == y + by.y;
            if (level < MULTIVIEW_REFINE) {
                floatn first = first_between(inv_depth, extent, size, c1, c0, ends, x, row, is_inside);
                floatn half_of = first < c ? (floatn)(2.0f * k) : (floatn)(2.0f * k + 1.0f);
                if (level == 0) half_of = first < MULTIVIEW_NOWHERE ? half_of : (floatn)(-1.0f);
                next = is_here > 0.0f ? half_of : next;
            } else {
                floatn met[4];
                peeled_quads(met, color, inv_depth, extent, size, ends, x, row, is_inside, row != y + by.y);
                const floatp here[4] = FOUR_PARTS(is_here);
                for (int q = 0; q < 4; q++) quad[q] += met[q] * spread(here[q]);
            }
        }
        part = next;
    }
}
#endif

/* What a lens of radius 0 sees: where every ray of a pixel is lost. */
static inline float4 pinhole(const __global float *color, MultiviewSize size, int x, int y)
{
    const size_t width = (size_t)size.width * MULTIVIEW_SCALE, height = (size_t)size.height * MULTIVIEW_SCALE;
    const int middle = MULTIVIEW_SCALE / 2;
    float4 v = (float4)(0.0f);
    for (int m = size.peels - 1; m >= 0; m--) {
        const size_t row = m * height + y * MULTIVIEW_SCALE + middle;
        float4 front = load_pixel(color + (row * width + x * MULTIVIEW_SCALE + middle) * 4);
        v = front + (1.0f - front.w) * v;
    }
    return v;
}

/* A pixel from the sum of what rays have met; `clear` is that of rays that went past everything. */
static inline float4 resolved(float4 sum, float clear, float least, const __global float *color, MultiviewSize size,
                              int x, int y)
{
    const float known = sum.w + clear;
    if (known <= least) return pinhole(color, size, x, y);
    float4 v = sum / known;
#if MULTIVIEW_VOID
    v.w = v.w > 1.0f ? 1.0f : v.w;
#else
    v.w = 1.0f;
#endif
    return v;
}

/* multiview_finish: the image from the sums of all groups of rays.
 * reads   parts  float[output height][output width][4], then clear float[output height][output width]
 *         color  float[peels][height][width][4]
 * writes  image  float[output height][output width][4]
 * range   2-D, one item per row of the output: (1, output height), any local size */
__kernel void multiview_finish(__global float *restrict image, const __global float *restrict parts,
                               const __global float *restrict color, MultiviewSize size, int guard)
{
    const int y = get_global_id(1), width = size.width - 2 * guard, height = size.height - 2 * guard;
    if (y >= height) return;
    const __global float *clear = parts + (size_t)width * height * 4;
    for (int x = 0; x < width; x++) {
        const size_t at = (size_t)y * width + x;
        const float4 v = resolved(load_pixel(parts + at * 4), MULTIVIEW_VOID ? clear[at] : 0.0f, MULTIVIEW_LEAST, color,
                                  size, x + guard, y + guard);
        store_pixel(image + at * 4, v);
    }
}

/* multiview_trace: all rays of LANES pixels, front to back through the layers of their cells.
 * source  sections 4.3 and 4.4: v1 * c1 + (1 - v1) * c2
 * reads   layers    float[layers (+ 1)][height][pitch][4]
 *         color     float[peels][fine height][width][4]
 *         inv_depth, extent, places  as multiview_split has them; with MULTIVIEW_PEELED only, in place of layers
 *         points    float2[rays]       as multiview_shifts has them; with MULTIVIEW_REFINE only
 *         lists     uint[cells_y][cells_x]
 *         sets      int[cells_y][cells_x]
 *         ray_sets  int2[sets * STRIDE^2]  first ray and number of rays
 *         shifts    MultiviewShift[rays][layers]
 *         gaps      ushort[cells_y][cells_x]  0 in cells that are asked for; with MULTIVIEW_SPARSE the others are left
 *                   as they are
 * writes  image     float[output height][output width][4]; or, with MULTIVIEW_PARTS, adds to parts as multiview_finish
 *                   has them, or begins them with the `first` group
 * range   2-D, one item per MULTIVIEW_AT_ONCE pixels of a row, any local size */
__kernel void multiview_trace(__global float *restrict image, const __global float *restrict layers,
                              const __global uint *restrict lists, const __global int *restrict sets,
                              const __global int2 *restrict ray_sets, const __global MultiviewShift *restrict shifts,
                              const __global float *restrict color,
#if MULTIVIEW_PEELED
                              const __global float *restrict inv_depth, const __global float *restrict extent,
                              const __global MultiviewPlaces *restrict places,
#if MULTIVIEW_REFINE
                              const __global float2 *restrict points, float c1, float c0,
#endif
#endif
                              MultiviewSize size, int guard
#if MULTIVIEW_PARTS
                              , int first
#endif
#if MULTIVIEW_SPARSE
                              , const __global ushort *restrict gaps
#endif
)
{
    const int start = MULTIVIEW_AT_ONCE * (int)get_global_id(0), y = (int)get_global_id(1) + guard;
    const int end_x = size.width - guard;
    if (start >= end_x || start + MULTIVIEW_AT_ONCE <= guard || y >= size.height - guard) return;
    const int first_cell = start / MULTIVIEW_SPAN * MULTIVIEW_STRIDE;
#if MULTIVIEW_SPARSE
    const __global ushort *row_gaps = gaps + y / MULTIVIEW_CELL * size.cells_x;
    int is_asked_for = 0;
    for (int i = 0; i < MULTIVIEW_STRIDE; i++)
        is_asked_for |= row_gaps[clamp_index(first_cell + i, size.cells_x - 1)] == 0;
    if (!is_asked_for) return;
#endif
    uint list = 0u;
    int set = 0;
    for (int i = 0; i < MULTIVIEW_STRIDE; i++) {
        const int cx = clamp_index(first_cell + i, size.cells_x - 1);
        const int cell = y / MULTIVIEW_CELL * size.cells_x + cx;
        list |= lists[cell];
        set = set > sets[cell] ? set : sets[cell];
    }
    int order[MULTIVIEW_MAX_LAYERS], count = 0;
    for (int s = 0; s < size.layers; s++)
        if (list >> s & 1u) order[count++] = s;
    const size_t layer_floats = (size_t)size.height * size.pitch * 4;
    for (int phase = 0; phase < MULTIVIEW_STRIDE; phase++) {
        const int x0 = start + phase;
        const int pattern = (set * MULTIVIEW_STRIDE + y % MULTIVIEW_STRIDE) * MULTIVIEW_STRIDE + phase;
        const int2 rays = ray_sets[pattern];
        floatn sum[4] = {(floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f)};
#if MULTIVIEW_VOID
        floatn past[4] = {(floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f), (floatn)(0.0f)};
#endif
        for (int i = 0; i < rays.y; i++) {
            const __global MultiviewShift *shift = shifts + (size_t)(rays.x + i) * size.layers;
            floatn left[4] = {(floatn)(1.0f), (floatn)(1.0f), (floatn)(1.0f), (floatn)(1.0f)};
            float open = 1.0f;
            for (int k = 0; k < count + MULTIVIEW_VOID && open > 0.0f; k++) {
                const int s = k < count ? order[k] : size.layers;
                /* The void is at infinity, in the last layer. */
                const MultiviewShift by = shift[s < size.layers ? s : s - 1];
                const int x = x0 + by.x, row = y + by.y;
                const float share_x = by.to_x < 0.0f ? -by.to_x : by.to_x;
                const float share_y = by.to_y < 0.0f ? -by.to_y : by.to_y;
                const int over = by.to_x < 0.0f ? -1 : 1, down = by.to_y < 0.0f ? -1 : 1;
                const int is_between = !MULTIVIEW_REFINE && (share_x > 0.0f || share_y > 0.0f);
                const int rim = is_between ? 1 : 0;
                const int is_inside = x >= rim && x + MULTIVIEW_AT_ONCE + rim <= size.width && row >= rim &&
                                      row + rim < size.height;
                const __global float *layer = layers + (MULTIVIEW_PEELED ? 0 : s) * layer_floats;
                /* What the ray meets as far as it is known, and how much light that blocks. */
                floatn c[4], blocks[4];
                if (!MULTIVIEW_PEELED && is_inside) {
                    const __global float *at = layer + ((size_t)row * size.pitch + x) * 4;
#pragma unroll
                    for (int q = 0; q < 4; q++) c[q] = layer_quad(at + LANES * q * MULTIVIEW_STRIDE);
                    if (is_between) {
                        const __global float *side = at + 4 * over, *next = at + 4 * down * size.pitch;
                        const __global float *corner = next + 4 * over;
                        if (share_x > 0.0f)
#pragma unroll
                            for (int q = 0; q < 4; q++)
                                c[q] += share_x * (layer_quad(side + LANES * q * MULTIVIEW_STRIDE) - c[q]);
                        if (share_y > 0.0f)
#pragma unroll
                            for (int q = 0; q < 4; q++) {
                                floatn v = layer_quad(next + LANES * q * MULTIVIEW_STRIDE);
                                v += share_x * (layer_quad(corner + LANES * q * MULTIVIEW_STRIDE) - v);
                                c[q] += share_y * (v - c[q]);
                            }
                    }
#pragma unroll
                    for (int q = 0; q < 4; q++) blocks[q] = c[q].ALPHAS;
                } else {
                    for (int q = 0; q < 4; q++) c[q] = (floatn)(0.0f), blocks[q] = (floatn)(0.0f);
                    for (int tap = 0; tap < (is_between ? 4 : 1); tap++) {
                        const int is_over = tap & 1, is_down = tap >> 1;
                        float share = 1.0f;
                        if (is_between)
                            share = (is_over ? share_x : 1.0f - share_x) * (is_down ? share_y : 1.0f - share_y);
                        if (share <= 0.0f) continue;
                        const int column = x + is_over * over, line = row + is_down * down;
                        const int inside = clamp_index(line, size.height - 1);
                        floatn v[4];
#if MULTIVIEW_PEELED
                        if (s < size.layers) {
                            const float2 ends = ends_of(places, s, size.layers);
#if MULTIVIEW_REFINE
                            const float2 limits = (float2)(places->bound[s], places->bound[s + 1]) * c1 + c0;
                            refined_quads(v, color, inv_depth, extent, size, c1, c0, ends, limits, points[rays.x + i],
                                          x0, y);
#else
                            const int is_whole = column >= 0 && column + MULTIVIEW_AT_ONCE <= size.width && line == inside;
                            peeled_quads(v, color, inv_depth, extent, size, ends, column, inside, is_whole,
                                         line != inside);
#endif
                        } else
#endif
                            for (int q = 0; q < 4; q++)
                                v[q] = edge_quad(layer + (size_t)inside * size.pitch * 4,
                                                 column + PIXELS * q * MULTIVIEW_STRIDE, line != inside, size.width);
                        for (int q = 0; q < 4; q++) {
                            floatn alpha = v[q].ALPHAS;
                            c[q] += alpha < 0.0f ? (floatn)(0.0f) : share * v[q];
                            blocks[q] += share * (alpha < 0.0f ? -alpha : alpha);
                        }
                    }
                }
                floatn rest = (floatn)(0.0f);
#if MULTIVIEW_VOID
                if (s == size.layers) {
#pragma unroll
                    for (int q = 0; q < 4; q++) past[q] += left[q] * c[q];
                    continue;
                }
#endif
#pragma unroll
                for (int q = 0; q < 4; q++) {
                    sum[q] += left[q] * c[q];
                    left[q] -= left[q] * blocks[q];
                    rest += left[q];
                }
                open = sum_lanes(rest);
            }
        }
        __global float *out = image + (size_t)(y - guard) * (size.width - 2 * guard) * 4;
#pragma unroll
        for (int q = 0; q < 4; q++) {
#pragma unroll
            for (int j = 0; j < PIXELS; j++) {
                const float4 p = pixel_of(sum[q], j);
                const int x = x0 + (PIXELS * q + j) * MULTIVIEW_STRIDE;
                if (x < guard || x >= end_x) continue;
#if MULTIVIEW_SPARSE
                if (row_gaps[x / MULTIVIEW_CELL] != 0) continue;
#endif
#if MULTIVIEW_VOID
                const float past_all = pixel_of(past[q], j).w;
#else
                const float past_all = 0.0f;
#endif
#if MULTIVIEW_PARTS
                __global float *sums = out + (x - guard) * 4;
                store_pixel(sums, first ? p : load_pixel(sums) + p);
#if MULTIVIEW_VOID
                const int width = size.width - 2 * guard, height = size.height - 2 * guard;
                __global float *gone = image + (size_t)width * height * 4 + (size_t)(y - guard) * width + (x - guard);
                *gone = first ? past_all : *gone + past_all;
#endif
#else
                const float least = MULTIVIEW_LEAST * (float)rays.y;
                store_pixel(out + (x - guard) * 4, resolved(p, past_all, least, color, size, x, y));
#endif
            }
        }
    }
}
