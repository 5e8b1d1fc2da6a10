/* multiview.cl: rays through a layered image-based scene (Lee, Eisemann & Seidel 2009).
 *
 * The lens ray through pixel p and lens point v meets the signed CoC radius C at pixel p + C * (-v.x, v.y), y down: in
 * pixels and C rays are straight (eq. 3 of the paper). The frame's peels are split into layers of equal CoC growth
 * (eq. 4), so thin that a ray moves by less than a pixel inside one. There the height field needs no search, and all
 * 16 pixels of a run move by the same whole number of pixels: the way of 16 rays through a layer is one contiguous,
 * unaligned load. Gathers, which CPUs are slow at, do not occur.
 *
 * Layer s holds the C in [low + s * delta, low + (s + 1) * delta) and is met at the middle of that. Layers are
 * float[height][pitch][4], premultiplied; alpha is how much of the pixel, or of the cone around it, the layer blocks.
 * Cells are MULTIVIEW_CELL x MULTIVIEW_CELL pixels; bit s of a cell's mask says that layer s has something there. */

#include "common.clh"

#define MULTIVIEW_CELL 16
#define MULTIVIEW_MAX_LAYERS 32
/* Farther in px than any CoC: where slots with nothing in them stand. */
#define MULTIVIEW_NOWHERE 1e30f
/* Slots at least this opaque are taken for opaque. */
#define MULTIVIEW_OPAQUE 0.998f
/* What a column of peels may let through and still count as closed; as LayeredFrame.is_opaque has it. */
#define MULTIVIEW_CLOSED 1e-3f
/* Steps in px from one pixel to the next that belong to one surface. */
#define MULTIVIEW_CONNECTED 2.0f
/* Below this share of rays that met something known, a pixel is what a pinhole sees. */
#define MULTIVIEW_LEAST 1e-4f
/* Pixels that a cone may reach to either side, a multiple of 4, and pixels of a row that an item of the filter makes. */
#define MULTIVIEW_HALO 16
#define MULTIVIEW_RUN 64

/* 1: the frame's image is not opaque. Layer `layers` of the stack then holds, in alpha, where the view goes past the
 * scene. */
#ifndef MULTIVIEW_VOID
#define MULTIVIEW_VOID 0
#endif
/* Pixels from one lane of a run to the next: 1, or 4 when pixels have 4 x 4 different sets of rays. */
#ifndef MULTIVIEW_STRIDE
#define MULTIVIEW_STRIDE 1
#endif
#define MULTIVIEW_SPAN (16 * MULTIVIEW_STRIDE)
/* 1: rays walk the peels themselves; there is no stack of layers but for the void. */
#ifndef MULTIVIEW_PEELED
#define MULTIVIEW_PEELED 0
#endif
/* 1: rays come in groups, each through layers of its own (shading_view), and are summed up in `parts`. */
#ifndef MULTIVIEW_PARTS
#define MULTIVIEW_PARTS 0
#endif

typedef struct {
    int width, height, pitch, peels, layers, cells_x, cells_y;
} MultiviewSize;

static inline float16 coc_of(float16 w, float c1, float c0)
{
    float16 c = w * c1 + c0;
    return w < 0.0f ? (float16)(MULTIVIEW_NOWHERE) : c;
}

/* How far a surface goes on behind a slot on its way to the next pixel: the lesser step of both sides, so that a
 * silhouette does not count, and nothing where neither side is connected. */
static inline float16 step_of(float16 c, float16 a, float16 b)
{
    float16 to_a = c > a ? c - a : a - c, to_b = c > b ? c - b : b - c;
    to_a = to_a < to_b ? to_a : to_b;
    return to_a > MULTIVIEW_CONNECTED ? (float16)(0.0f) : to_a;
}

/* multiview_extent: the far end of every slot. A slot is a column from its own C to there, so that no ray slips
 * between the pixels of a slope.
 * source  takes the place of the fixed 10 % overlap of layers, section 4.2
 * reads   inv_depth  float[peels][height][pitch]  1/m
 * writes  extent     float[peels][height][pitch]  px, C of the far end; -MULTIVIEW_NOWHERE where nothing is
 * range   3-D, one item per 16 pixels of a row of a peel, any local size */
__kernel void multiview_extent(__global float *restrict extent, const __global float *restrict inv_depth,
                               MultiviewSize size, float c1, float c0)
{
    const int x = 16 * (int)get_global_id(0), y = get_global_id(1), m = get_global_id(2);
    if (x >= size.pitch || y >= size.height || m >= size.peels) return;
    const size_t at = ((size_t)m * size.height + y) * size.pitch + x;
    const __global float *inv = inv_depth + at;
    const float16 none = (float16)(MULTIVIEW_NOWHERE);
    float16 w = load_quad(inv), c = coc_of(w, c1, c0);
    /* The ends of a row stand for their own neighbours. */
    float16 left = x > 0 ? coc_of(load_quad(inv - 1), c1, c0) : (float16)(none.s0, c.s01234567, c.s89ab, c.scd, c.se);
    float16 right = x + 16 < size.pitch ? coc_of(load_quad(inv + 1), c1, c0)
                                        : (float16)(c.s12345678, c.s9abc, c.sde, c.sf, none.s0);
    float16 above = y > 0 ? coc_of(load_quad(inv - size.pitch), c1, c0) : none;
    float16 below = y + 1 < size.height ? coc_of(load_quad(inv + size.pitch), c1, c0) : none;
    float16 end = c + (step_of(c, left, right) + step_of(c, above, below));
    store_quad(extent + at, w < 0.0f ? -none : end);
}

/* multiview_cells: which layers have something in a cell; the first level of the N-buffer.
 * A slot close to the bound of two layers counts for both: a mask may say too much, never too little.
 * reads   inv_depth  float[peels][height][pitch]  1/m
 *         extent     float[peels][height][pitch]  px
 * writes  nbuffer    uint[0][cells_y][cells_x]    bit s: layer s
 * range   2-D, one item per cell, any local size */
__kernel void multiview_cells(__global uint *restrict nbuffer, const __global float *restrict inv_depth,
                              const __global float *restrict extent, MultiviewSize size, float c1, float c0, float low,
                              float delta)
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= size.cells_x || cy >= size.cells_y) return;
    const int y_end = (cy + 1) * MULTIVIEW_CELL < size.height ? (cy + 1) * MULTIVIEW_CELL : size.height;
    const float scale = 1.0f / delta, last = (float)(size.layers - 1);
    uint16 mask = (uint16)(0u);
    for (int m = 0; m < size.peels; m++)
        for (int y = cy * MULTIVIEW_CELL; y < y_end; y++) {
            const size_t at = ((size_t)m * size.height + y) * size.pitch + MULTIVIEW_CELL * cx;
            float16 w = load_quad(inv_depth + at);
            float16 from = (w * c1 + c0 - low) * scale - 1e-3f, to = (load_quad(extent + at) - low) * scale + 1e-3f;
            from = from < 0.0f ? (float16)(0.0f) : from;
            from = from > last ? (float16)(last) : from;
            to = to > last ? (float16)(last) : to;
            to = to < from ? from : to;
            uint16 bits = ((uint16)(2u) << convert_uint16(to)) - ((uint16)(1u) << convert_uint16(from));
            mask |= w < 0.0f ? (uint16)(0u) : bits;
        }
    uint8 a = mask.lo | mask.hi;
    uint4 b = a.lo | a.hi;
    nbuffer[cy * size.cells_x + cx] = b.x | b.y | b.z | b.w;
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

/* multiview_lists: the layers that any ray through a cell can meet, and how many rays that takes.
 * reads   nbuffer  uint[levels][cells_y][cells_x]
 *         reach    int[layers]   cells that rays and cones of a layer may move to either side
 *         needs    int[layers]   set of rays for the blur of a layer
 * writes  lists    uint[cells_y][cells_x]  bit s: layer s
 *         sets     int[cells_y][cells_x]   set of rays
 * range   2-D, one item per cell, any local size */
__kernel void multiview_lists(__global uint *restrict lists, __global int *restrict sets,
                              const __global uint *restrict nbuffer, const __global int *restrict reach,
                              const __global int *restrict needs, MultiviewSize size, int levels, int cull)
{
    const int cx = get_global_id(0), cy = get_global_id(1);
    if (cx >= size.cells_x || cy >= size.cells_y) return;
    const size_t plane = (size_t)size.cells_x * size.cells_y;
    uint list = 0u;
    int set = 0;
    for (int s = 0; s < size.layers; s++) {
        const int r = reach[s];
        const int x0 = cx > r ? cx - r : 0, x1 = clamp_index(cx + r, size.cells_x - 1);
        const int y0 = cy > r ? cy - r : 0, y1 = clamp_index(cy + r, size.cells_y - 1);
        const int across = x1 - x0 + 1, down = y1 - y0 + 1, side = across < down ? across : down;
        int n = 0;
        while (n + 1 < levels && 2 << n <= side) n++;
        /* Four squares, or more where the window is cut by the frame into a long one. */
        const int last_x = x1 + 1 - (1 << n), last_y = y1 + 1 - (1 << n);
        uint mask = 0u;
        for (int y = y0;; y = y + (1 << n) < last_y ? y + (1 << n) : last_y) {
            for (int x = x0;; x = x + (1 << n) < last_x ? x + (1 << n) : last_x) {
                mask |= nbuffer[n * plane + y * size.cells_x + x];
                if (x == last_x) break;
            }
            if (y == last_y) break;
        }
        if (!(mask >> s & 1u)) continue;
        list |= 1u << s;
        set = set > needs[s] ? set : needs[s];
    }
    lists[cy * size.cells_x + cx] = cull ? list : ~0u >> (MULTIVIEW_MAX_LAYERS - size.layers);
    sets[cy * size.cells_x + cx] = set;
}

/* multiview_split: one layer, the nearest slots inside it; several peels of glass one over the other.
 * source  eq. 4; exact where the paper's single pass may lose fragments of triangles that cross a bound
 * reads   color      float[peels][height][width][4]
 *         inv_depth  float[peels][height][pitch]  1/m
 *         extent     float[peels][height][pitch]  px
 *         nbuffer    uint[0][cells_y][cells_x]
 * writes  layers     float[slot][height][pitch][4]
 * range   2-D, one item per cell, any local size */
__kernel void multiview_split(__global float *restrict layers, const __global float *restrict color,
                              const __global float *restrict inv_depth, const __global float *restrict extent,
                              const __global uint *restrict nbuffer, MultiviewSize size, float c1, float c0, float from,
                              float to, int layer, int slot)
{
    const int cx = get_global_id(0), cy = get_global_id(1), x = MULTIVIEW_CELL * cx;
    if (cx >= size.cells_x || cy >= size.cells_y) return;
    const int y_end = (cy + 1) * MULTIVIEW_CELL < size.height ? (cy + 1) * MULTIVIEW_CELL : size.height;
    const int peels = nbuffer[cy * size.cells_x + cx] >> layer & 1u ? size.peels : 0;
    for (int y = cy * MULTIVIEW_CELL; y < y_end; y++) {
        float16 quad[4] = {(float16)(0.0f), (float16)(0.0f), (float16)(0.0f), (float16)(0.0f)};
        for (int m = 0; m < peels; m++) {
            const size_t row = (size_t)m * size.height + y;
            float16 c = load_quad(inv_depth + row * size.pitch + x) * c1 + c0;
            float16 end = load_quad(extent + row * size.pitch + x);
            float16 in = c < to && end >= from ? (float16)(1.0f) : (float16)(0.0f);
            if (sum16(in) == 0.0f) continue;
            float16 own = c >= from ? in : (float16)(0.0f);
            const __global float *rgba = color + (row * size.width + x) * 4;
            const float4 ins[4] = {in.s0123, in.s4567, in.s89ab, in.scdef};
            const float4 owns[4] = {own.s0123, own.s4567, own.s89ab, own.scdef};
#pragma unroll
            for (int q = 0; q < 4; q++) {
                const int valid = size.width - x - 4 * q;
                if (valid <= 0) continue;
                float16 v = valid >= 4 ? load_quad(rgba + 16 * q) : load_quad_part(rgba + 16 * q, valid);
                /* An opaque slot may be met twice, glass must not. */
                float4 weight = v.s37bf >= MULTIVIEW_OPAQUE ? ins[q] : owns[q];
                quad[q] += v * spread((1.0f - quad[q].s37bf) * weight);
            }
        }
        __global float *out = layers + (((size_t)slot * size.height + y) * size.pitch + x) * 4;
#pragma unroll
        for (int q = 0; q < 4; q++) store_quad(out + 16 * q, quad[q]);
    }
}

/* multiview_past: where the void is seen past everything in a frame that is not opaque: in columns of peels that let
 * light through, and behind those that end before the last peel, since nothing else can be there.
 * reads   color   float[peels][height][width][4]
 * writes  layers  float[slot][height][pitch][4]  (0, 0, 0, 1) where the void is known to be, else 0
 * range   2-D, one item per row: (1, height), any local size */
__kernel void multiview_past(__global float *restrict layers, const __global float *restrict color, MultiviewSize size,
                             int slot)
{
    const int y = get_global_id(1);
    if (y >= size.height) return;
    __global float *out = layers + ((size_t)slot * size.height + y) * size.pitch * 4;
    for (int x = 0; x < size.pitch; x++) {
        float through = x < size.width ? 1.0f : 0.0f, alpha = 1.0f;
        for (int m = 0; m < (x < size.width ? size.peels : 0); m++) {
            alpha = color[(((size_t)m * size.height + y) * size.width + x) * 4 + 3];
            through *= 1.0f - alpha;
        }
        const int is_void = through > MULTIVIEW_CLOSED || alpha == 0.0f;
        store_pixel(out + 4 * x, (float4)(0.0f, 0.0f, 0.0f, is_void ? 1.0f : 0.0f));
    }
}

/* multiview_cone: one layer as cones see it: the mean over a square window as wide as the cone is there.
 * source  section 4.4. All cones of a layer have the same width there, so that full-size means take the place of mip
 *         levels: no steps between levels, and still one look-up a ray
 * reads   image    float[height][pitch][4]
 *         nbuffer  uint[0][cells_y][cells_x]
 * writes  layers   float[slot][height][pitch][4]
 * scalars window of 2 * radius + 1 whole pixels and `edge` (0 to 1) of one more at either side
 * range   2-D, one item per MULTIVIEW_RUN x MULTIVIEW_CELL pixels, any local size */
__kernel void multiview_cone(__global float *restrict layers, const __global float *restrict image,
                             const __global uint *restrict nbuffer, MultiviewSize size, int layer, int slot, int radius,
                             float edge)
{
    const int x0 = MULTIVIEW_RUN * (int)get_global_id(0), cy = get_global_id(1);
    if (x0 >= size.pitch || cy >= size.cells_y) return;
    const int y_end = (cy + 1) * MULTIVIEW_CELL < size.height ? (cy + 1) * MULTIVIEW_CELL : size.height;
    const int x1 = x0 + MULTIVIEW_RUN < size.pitch ? x0 + MULTIVIEW_RUN : size.pitch;
    const float scale = 1.0f / ((float)(2 * radius + 1) + 2.0f * edge);
    uint around = 0u;
    for (int j = cy - 1; j <= cy + 1; j++)
        for (int i = x0 / MULTIVIEW_CELL - 1; i <= (x0 + MULTIVIEW_RUN) / MULTIVIEW_CELL; i++)
            if (i >= 0 && j >= 0 && i < size.cells_x && j < size.cells_y) around |= nbuffer[j * size.cells_x + i];
    const int is_empty = !(around >> layer & 1u);
    float line[(MULTIVIEW_RUN + 2 * MULTIVIEW_HALO) * 4];
    for (int y = cy * MULTIVIEW_CELL; y < y_end; y++) {
        __global float *out = layers + ((size_t)slot * size.height + y) * size.pitch * 4;
        if (is_empty) {
            for (int x = x0; x < x1; x += 4) store_quad(out + x * 4, (float16)(0.0f));
            continue;
        }
        for (int j = 0; j < MULTIVIEW_RUN + 2 * MULTIVIEW_HALO; j += 4) {
            const int x = x0 - MULTIVIEW_HALO + j;
            float16 sum = (float16)(0.0f);
            if (x >= 0 && x < size.pitch)
                for (int t = -radius - 1; t <= radius + 1; t++) {
                    const int from = clamp_index(y + t, size.height - 1);
                    const float weight = t < -radius || t > radius ? edge : 1.0f;
                    sum += (weight * scale) * load_quad(image + ((size_t)from * size.pitch + x) * 4);
                }
            *(float16_unaligned *)(line + 4 * j) = sum;
        }
        /* Beyond the frame its edge goes on. */
        for (int j = 0; j < MULTIVIEW_RUN + 2 * MULTIVIEW_HALO; j++) {
            const int x = x0 - MULTIVIEW_HALO + j, inside = clamp_index(x, size.width - 1);
            if (x != inside)
                for (int c = 0; c < 4; c++) line[4 * j + c] = line[4 * (inside - x0 + MULTIVIEW_HALO) + c];
        }
        for (int x = x0; x < x1; x += 4) {
            const float *at = line + 4 * (MULTIVIEW_HALO + x - x0);
            float16 sum = edge * (*(const float16_unaligned *)(at - 4 * (radius + 1)) +
                                  *(const float16_unaligned *)(at + 4 * (radius + 1)));
            for (int t = -radius; t <= radius; t++) sum += *(const float16_unaligned *)(at + 4 * t);
            store_quad(out + x * 4, sum * scale);
        }
    }
}

/* Four pixels of a layer, MULTIVIEW_STRIDE apart. */
static inline float16 layer_quad(const __global float *p)
{
#if MULTIVIEW_STRIDE == 1
    return load_quad(p);
#else
    return (float16)(load_pixel(p), load_pixel(p + 4 * MULTIVIEW_STRIDE), load_pixel(p + 8 * MULTIVIEW_STRIDE),
                     load_pixel(p + 12 * MULTIVIEW_STRIDE));
#endif
}

/* The same at pixel x of a row, where some of them may lie outside of the frame. There its edge goes on, but of unknown
 * colour: rays that meet it are dropped. What is outside has a negative alpha. */
static inline float16 edge_quad(const __global float *row, int x, int is_outside, int width)
{
    float4 p[4];
    for (int j = 0; j < 4; j++) {
        const int at = x + j * MULTIVIEW_STRIDE, inside = clamp_index(at, width - 1);
        p[j] = load_pixel(row + 4 * inside);
        p[j] = at != inside || is_outside ? (float4)(0.0f, 0.0f, 0.0f, -p[j].w) : p[j];
    }
    return (float16)(p[0], p[1], p[2], p[3]);
}

#if MULTIVIEW_PEELED
/* One value of each pixel of a run; beyond the frame its edge goes on. */
static inline float16 run_of(const __global float *row, int x, int is_inside, int width)
{
#if MULTIVIEW_STRIDE == 1
    if (is_inside) return load_quad(row + x);
#endif
    float v[16];
    for (int j = 0; j < 16; j++) v[j] = row[clamp_index(x + j * MULTIVIEW_STRIDE, width - 1)];
    return *(const float16_unaligned *)v;
}

/* What multiview_split would have put into a layer for 16 pixels, straight from the peels. */
static inline void peeled_quads(float16 quad[4], const __global float *color, const __global float *inv_depth,
                                const __global float *extent, MultiviewSize size, float c1, float c0, float from,
                                float to, int x, int row, int is_inside, int is_outside)
{
    for (int q = 0; q < 4; q++) quad[q] = (float16)(0.0f);
    for (int m = 0; m < size.peels; m++) {
        const size_t line = (size_t)m * size.height + row;
        float16 end = run_of(extent + line * size.pitch, x, is_inside, size.width);
        float16 near = run_of(inv_depth + line * size.pitch, x, is_inside, size.width) * c1 + c0;
        float16 in = near < to && end >= from ? (float16)(1.0f) : (float16)(0.0f);
        if (sum16(in) == 0.0f) continue;
        float16 own = near >= from ? in : (float16)(0.0f);
        const __global float *rgba = color + line * size.width * 4;
        const float4 ins[4] = {in.s0123, in.s4567, in.s89ab, in.scdef};
        const float4 owns[4] = {own.s0123, own.s4567, own.s89ab, own.scdef};
        for (int q = 0; q < 4; q++) {
            const int at = x + 4 * q * MULTIVIEW_STRIDE;
            float16 v = is_inside ? layer_quad(rgba + at * 4) : edge_quad(rgba, at, is_outside, size.width);
            float4 alpha = v.s37bf < 0.0f ? -v.s37bf : v.s37bf;
            float4 weight = alpha >= MULTIVIEW_OPAQUE ? ins[q] : owns[q];
            float4 covered = quad[q].s37bf < 0.0f ? -quad[q].s37bf : quad[q].s37bf;
            quad[q] += v * spread((1.0f - covered) * weight);
        }
    }
}
#endif

/* What a lens of radius 0 sees: where every ray of a pixel is lost. */
static inline float4 pinhole(const __global float *color, MultiviewSize size, int x, int y)
{
    float4 v = (float4)(0.0f);
    for (int m = size.peels - 1; m >= 0; m--) {
        float4 front = load_pixel(color + (((size_t)m * size.height + y) * size.width + x) * 4);
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

/* multiview_trace: all rays of 16 pixels, front to back through the layers of their cells.
 * source  sections 4.3 and 4.4: v1 * c1 + (1 - v1) * c2
 * reads   layers    float[layers (+ 1)][height][pitch][4]
 *         color     float[peels][height][width][4]
 *         inv_depth, extent, bounds  as multiview_split has them; with MULTIVIEW_PEELED only, in place of layers
 *         lists     uint[cells_y][cells_x]
 *         sets      int[cells_y][cells_x]
 *         ray_sets  int2[sets * STRIDE^2]  first ray and number of rays
 *         shifts    int2[rays][layers]  px, how far each ray has moved at each layer
 * writes  image     float[output height][output width][4]; or, with MULTIVIEW_PARTS, adds to parts as multiview_finish
 *                   has them, or begins them with the `first` group
 * range   2-D, one item per MULTIVIEW_SPAN pixels of an output row, any local size */
__kernel void multiview_trace(__global float *restrict image, const __global float *restrict layers,
                              const __global uint *restrict lists, const __global int *restrict sets,
                              const __global int2 *restrict ray_sets, const __global int2 *restrict shifts,
                              const __global float *restrict color,
#if MULTIVIEW_PEELED
                              const __global float *restrict inv_depth, const __global float *restrict extent,
                              const __global float *restrict bounds, float c1, float c0,
#endif
                              MultiviewSize size, int guard
#if MULTIVIEW_PARTS
                              , int first
#endif
)
{
    const int start = MULTIVIEW_SPAN * (int)get_global_id(0), y = (int)get_global_id(1) + guard;
    const int end_x = size.width - guard;
    if (start >= end_x || start + MULTIVIEW_SPAN <= guard || y >= size.height - guard) return;
    uint list = 0u;
    int set = 0;
    for (int i = 0; i < MULTIVIEW_STRIDE; i++) {
        const int cx = clamp_index(start / MULTIVIEW_CELL + i, size.cells_x - 1);
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
        float16 sum[4] = {(float16)(0.0f), (float16)(0.0f), (float16)(0.0f), (float16)(0.0f)};
#if MULTIVIEW_VOID
        float16 past[4] = {(float16)(0.0f), (float16)(0.0f), (float16)(0.0f), (float16)(0.0f)};
#endif
        for (int i = 0; i < rays.y; i++) {
            const __global int2 *shift = shifts + (size_t)(rays.x + i) * size.layers;
            float16 left[4] = {(float16)(1.0f), (float16)(1.0f), (float16)(1.0f), (float16)(1.0f)};
            float open = 1.0f;
            for (int k = 0; k < count + MULTIVIEW_VOID && open > 0.0f; k++) {
                const int s = k < count ? order[k] : size.layers;
                /* The void is at infinity, in the last layer. */
                const int2 by = shift[s < size.layers ? s : s - 1];
                const int x = x0 + by.x, row = y + by.y, inside = clamp_index(row, size.height - 1);
                float16 c[4];
                const int is_inside = x >= 0 && x + MULTIVIEW_SPAN <= size.width && row == inside;
#if MULTIVIEW_PEELED
                if (s < size.layers) {
                    peeled_quads(c, color, inv_depth, extent, size, c1, c0, bounds[s], bounds[s + 1], x, inside,
                                 is_inside, row != inside);
                } else
#endif
                {
                    const int slot = MULTIVIEW_PEELED ? 0 : s;
                    const __global float *from = layers + slot * layer_floats + (size_t)inside * size.pitch * 4;
#pragma unroll
                    for (int q = 0; q < 4; q++) {
                        const int at = x + 4 * q * MULTIVIEW_STRIDE;
                        c[q] = is_inside ? layer_quad(from + at * 4) : edge_quad(from, at, row != inside, size.width);
                    }
                }
                float16 rest = (float16)(0.0f);
#if MULTIVIEW_VOID
                if (s == size.layers) {
#pragma unroll
                    for (int q = 0; q < 4; q++) past[q] += c[q] > 0.0f ? left[q] * c[q] : (float16)(0.0f);
                    continue;
                }
#endif
#pragma unroll
                for (int q = 0; q < 4; q++) {
                    float16 alpha = c[q].s33337777bbbbffff;
                    sum[q] += alpha < 0.0f ? (float16)(0.0f) : left[q] * c[q];
                    left[q] -= left[q] * (alpha < 0.0f ? -alpha : alpha);
                    rest += left[q];
                }
                open = sum16(rest);
            }
        }
        __global float *out = image + (size_t)(y - guard) * (size.width - 2 * guard) * 4;
#pragma unroll
        for (int q = 0; q < 4; q++) {
            const float4 p[4] = {sum[q].s0123, sum[q].s4567, sum[q].s89ab, sum[q].scdef};
#if MULTIVIEW_VOID
            const float clear[4] = {past[q].s3, past[q].s7, past[q].sb, past[q].sf};
#endif
            for (int j = 0; j < 4; j++) {
                const int x = x0 + (4 * q + j) * MULTIVIEW_STRIDE;
                if (x < guard || x >= end_x) continue;
#if MULTIVIEW_VOID
                const float past_all = clear[j];
#else
                const float past_all = 0.0f;
#endif
#if MULTIVIEW_PARTS
                __global float *sums = out + (x - guard) * 4;
                store_pixel(sums, first ? p[j] : load_pixel(sums) + p[j]);
#if MULTIVIEW_VOID
                const int width = size.width - 2 * guard, height = size.height - 2 * guard;
                __global float *gone = image + (size_t)width * height * 4 + (size_t)(y - guard) * width + (x - guard);
                *gone = first ? past_all : *gone + past_all;
#endif
#else
                const float least = MULTIVIEW_LEAST * (float)rays.y;
                store_pixel(out + (x - guard) * 4, resolved(p[j], past_all, least, color, size, x, y));
#endif
            }
        }
    }
}
