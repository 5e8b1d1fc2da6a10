/* lightfield.cl: the light-field method (Yu, Wang & Yu 2010).
 *
 * A point of the lens, v in units of its radius, sees a surface of signed CoC radius C px (negative nearer than focus)
 * v * C px from where the reference view sees it, if its frustum is sheared so that the plane in focus stays where it
 * is. That is eq. 4 with the focal disparity of eq. 7 taken off already, so views add up pixel by pixel:
 *
 *   lightfield_tiles, lightfield_cull   which parts of the layers no view can see
 *   lightfield_slots       what is left to warp, and how far each slot reaches; once a frame
 *   lightfield_views       the nearest slot of every pixel of a view: one work-item a view, no atomics (CPUs)
 *   lightfield_clear, lightfield_depths, lightfield_sources     the same bits by atomic minimum (GPUs)
 *   lightfield_shrink      Gaussian pyramid of the layers
 *   lightfield_synthesize  wide-aperture sum over the views, colour looked up in the reference view
 *
 * Positions are whole numbers of 1/256 px. A product of two floats is rounded in the same way everywhere and then
 * truncated; only integers are added. So every device puts every slot into the same pixels.
 *
 * A winner is two words per pixel, view and plane: the source slot (low) and the order of its inverse depth (high).
 * As one 64-bit number the smallest is the nearest slot and, of equally near ones, the first in memory. NONE is a hole.
 * Plane 0 holds slots that hide what is behind them; planes 1.. hold glass, by how many panes its column has from it on
 * backwards, so that a pane stays in its plane where another ends in front of it. */

#include "common.clh"

/* How a slot's support is widened: 0 the nearest pixel, 1 the 2x2 or 2 the 3x3 around it (section 3.2), 3 as far as its
 * surface goes: half-way to neighbours of the same surface, and the pixel's own half where the surface ends. */
#ifndef LIGHTFIELD_SUPPORT
#define LIGHTFIELD_SUPPORT 3
#endif
/* Panes of glass in a column that keep apart: planes beside the first. 0: there is no glass. */
#ifndef LIGHTFIELD_GLASS
#define LIGHTFIELD_GLASS 0
#endif
/* 1: the frame is not opaque. */
#ifndef LIGHTFIELD_VOID
#define LIGHTFIELD_VOID 0
#endif
/* How a ray finds its colour: 0 that of the winner, 1 bilinear between the pixels of its surface, 2 a random pixel of
 * the surface within the ray's share of the lens. */
#ifndef LIGHTFIELD_LOOKUP
#define LIGHTFIELD_LOOKUP 1
#endif
/* Levels of the pyramid above the layers; 0: rays of any width see the layers themselves. */
#ifndef LIGHTFIELD_LEVELS
#define LIGHTFIELD_LEVELS 0
#endif
/* 1: colours lack what surfaces mirror, which every ray adds as its point of the lens sees it. */
#ifndef LIGHTFIELD_SHADED
#define LIGHTFIELD_SHADED 0
#endif
/* 1: only the tiles of 16 x 16 px that `gaps` asks for are made, and the rest of the image is left as it is. */
#ifndef LIGHTFIELD_SPARSE
#define LIGHTFIELD_SPARSE 0
#endif
/* 1: 64-bit atomic minimum. */
#ifndef LIGHTFIELD_PACKED
#define LIGHTFIELD_PACKED 0
#endif

#if LIGHTFIELD_SHADED
#include "shading.clh"
#endif

#define NONE 0xffffffffu
#define SUB 256.0f           /* positions per pixel */
#define EDGE_STEPS 16.0f     /* an edge is the difference of CoC to the neighbour, in 1/16 px; or codes of an end: */
#define END_CODE 128         /* the surface ends on this side: END_CODE + level; level 0 knows no more than the pixel */
#define END_LEVELS 7         /* levels -7 to 7 but 0 put the end (|level| - 1/2) / 14 px out or in */
#define END_STEP 18          /* 1/256 px a level */
#define END_NEAR 6           /* pixels of a silhouette to look at each way ... */
#define END_FAR 16           /* ... and farther on while it is straight along the axis */
#define EDGE_OVERLAP 8       /* 1/256 px: neighbours overlap by this much, so that rounding leaves no seam */
#define SAME_SURFACE_PX 1.0f /* neighbours whose CoC differ by no more are one surface: a gap of at most a pixel */
#define STEEP_PX 7.5f        /* at the most, for neighbours whose CoC go on in a straight line */
#define STRAIGHT 0.25f       /* second difference over first, below which a line is straight */
#define SIMILAR_PX 0.5f      /* colours are interpolated between CoC that differ by no more than this much ... */
#define SIMILAR_SHARE 0.125f /* ... and this share of the CoC */
#define OPAQUE_ALPHA 0.999f  /* as cldof.frame has it: less is glass */
#define MAX_COC_PX 1048576.0f
#define EDGE_PX 0.03125f     /* so near to an edge of the layers a ray is beyond it: more than positions are rounded by */
#define TILE 8               /* pixels each way, for culling */
#define CULL_RINGS 6         /* tiles round a tile that may hide it: CoC up to 45 px apart */
#define SEGMENT 32           /* pixels of a row that one item of lightfield_synthesize makes */
#define GAP_TILE 16          /* px, of the tiles that the planner asks for */
#define FOOTPRINT_PX 7.0f    /* a slot covers nothing farther from where it stands than its CoC and this */
#define MIN_WEIGHT 1e-4f     /* of all views together: less is a pixel that no view sees */

typedef struct {
    int width, height, pitch, peels;            /* of the layers, guard band included */
    int out_width, out_height, out_pitch, guard; /* of the views */
    int planes;
    int tiles_x, tiles_y;                       /* of the layers */
} LightfieldSize;

/* A view: v.x, v.y its point on the lens, y down; v.z, v.w where in its pixels it takes samples, whole 1/256 px around
 * the middle. Varied from view to view this makes a silhouette that moves by part of a pixel cover its part. */
typedef float4 LightfieldView;

typedef struct {
    float c1, c0; /* C = c1 * w + c0 in px */
    float cos4;   /* (aperture radius / focal length)^2; 0 leaves the attenuation out */
    float cell;   /* a ray's share of the CoC is 2 * |C| * cell px wide, and mip level log2(|C| * cell) shows it */
    int reach;    /* px: no slot moves farther than this */
    float radius; /* m, of the lens */
} LightfieldLens;

static inline float absolute_of(float v) { return v < 0.0f ? -v : v; }

#if LIGHTFIELD_SPARSE
/* Gaps of the tiles that row y of the frame goes through. */
static inline const __global ushort *gaps_of_row(const __global ushort *gaps, LightfieldSize size, int y)
{
    return gaps + (y / GAP_TILE) * ((size.width + GAP_TILE - 1) / GAP_TILE);
}

/* Whether any pixel of columns x0 to before x1 of a row is asked for. */
static inline int is_asked_for(const __global ushort *row_gaps, int x0, int x1)
{
    for (int t = x0 / GAP_TILE; t * GAP_TILE < x1; t++)
        if (row_gaps[t] == 0) return 1;
    return 0;
}

#define GAPS_PARAM const __global ushort *restrict gaps,
#else
#define GAPS_PARAM
#endif

/* An order that grows with w for every float, turned round: the nearest slot has the smallest key. */
static inline uint depth_key(float w)
{
    uint bits = as_uint(w);
    return bits & 0x80000000u ? bits : ~(bits | 0x80000000u);
}

static inline float coc_of(float w, LightfieldLens lens)
{
    float c = lens.c1 * w + lens.c0;
    c = c < -MAX_COC_PX ? -MAX_COC_PX : c;
    return c > MAX_COC_PX ? MAX_COC_PX : c;
}

static inline int is_in_layers(LightfieldSize size, int x, int y)
{
    return x >= 0 && x < size.width && y >= 0 && y < size.height;
}

/* Difference of CoC to the neighbour (dx, dy) of a slot if both belong to one surface, else MAXFLOAT. A step of more
 * than a pixel is a slope and no edge only where it goes on straight both ways. */
static inline float edge_of(const __global float *inv_depth, LightfieldSize size, LightfieldLens lens, int m, int x,
                            int y, int dx, int dy, float c)
{
    const int nx = x + dx, ny = y + dy;
    if (!is_in_layers(size, nx, ny)) return MAXFLOAT;
    const size_t plane = (size_t)size.height * size.pitch;
    const __global float *there = inv_depth + (size_t)ny * size.pitch + nx;
    const float w = there[m * plane];
    float d = MAXFLOAT;
    if (w >= 0.0f) {
        d = coc_of(w, lens) - c;
        if (absolute_of(d) <= SAME_SURFACE_PX) return d;
    }
    /* Beside a silhouette in front of it a surface goes on in another peel. */
    float best = MAXFLOAT;
    for (int other = 0; other < size.peels; other++) {
        const float v = there[other * plane], e = coc_of(v, lens) - c;
        best = other != m && v >= 0.0f && absolute_of(e) < absolute_of(best) ? e : best;
    }
    if (absolute_of(best) <= SAME_SURFACE_PX) return best;
    if (absolute_of(d) > STEEP_PX) return MAXFLOAT;
    const int ax = nx + dx, ay = ny + dy, bx = x - dx, by = y - dy;
    if (!is_in_layers(size, ax, ay) || !is_in_layers(size, bx, by)) return MAXFLOAT;
    const float ahead = inv_depth[m * plane + (size_t)ay * size.pitch + ax];
    const float behind = inv_depth[m * plane + (size_t)by * size.pitch + bx];
    const int is_straight = ahead >= 0.0f && absolute_of(coc_of(ahead, lens) - c - 2.0f * d) <= STRAIGHT * absolute_of(d)
                            && behind >= 0.0f && absolute_of(coc_of(behind, lens) - c + d) <= STRAIGHT * absolute_of(d);
    return is_straight ? d : MAXFLOAT;
}

/* Whether a pixel holds the surface of CoC c, in any peel. */
static inline int is_on_surface(const __global float *inv_depth, LightfieldSize size, LightfieldLens lens, int x, int y,
                                float c)
{
    if (!is_in_layers(size, x, y)) return 0;
    const __global float *there = inv_depth + (size_t)y * size.pitch + x;
    for (int m = 0; m < size.peels; m++, there += (size_t)size.height * size.pitch)
        if (*there >= 0.0f && absolute_of(coc_of(*there, lens) - c) <= SAME_SURFACE_PX) return 1;
    return 0;
}

/* Code of a silhouette on side (dx, dy) of a slot of CoC c. A pixel tells where an edge runs to half a pixel, but the
 * staircase along it tells more: its mean over a stretch that is centred here, with triangular weights, in whole
 * numbers. Where the staircase bends or is lost, the stretch ends. */
static inline uint end_code(const __global float *inv_depth, LightfieldSize size, LightfieldLens lens, int m, int x,
                            int y, int dx, int dy, float c)
{
    const __global float *own = inv_depth + ((size_t)m * size.height + y) * size.pitch + x;
    if (!is_in_layers(size, x + dx, y + dy)) return END_CODE;
    if (own[dy * size.pitch + dx] > *own) return END_CODE; /* it goes on behind something */
    int out[2] = {0, 0}, sum = 0, total = 0, length = 1, slope = 0, is_regular = 1;
    for (int k = 1; k <= END_FAR; k++) {
        int found = 0;
        for (int side = 0; side < 2; side++) {
            const int along = side ? k : -k, last = out[side];
            for (int i = 0; i < 3; i++) {
                const int j = last + (i == 0 ? 0 : i == 1 ? -1 : 1);
                const int u = x + along * (dy != 0) + j * dx, v = y + along * (dx != 0) + j * dy;
                if (!is_in_layers(size, u + dx, v + dy) || !is_on_surface(inv_depth, size, lens, u, v, c)
                    || is_on_surface(inv_depth, size, lens, u + dx, v + dy, c))
                    continue;
                out[side] = j;
                found++;
                break;
            }
        }
        const int bend = out[0] + out[1];
        if (found < 2 || bend > 1 || bend < -1) break;
        sum += bend;
        total += sum;
        length++;
        slope = k == 1 ? out[1] : slope;
        is_regular &= out[1] == k * slope && out[0] == -k * slope;
        if (k >= END_NEAR && out[0] != 0 && out[1] != 0) break;
    }
    if (is_regular) return END_CODE;
    const int level = (total < 0 ? -total : total) * 2 * END_LEVELS / (length * length) + 1;
    const int at_most = level < END_LEVELS ? level : END_LEVELS;
    return (uint)(END_CODE + (total < 0 ? -at_most : at_most));
}

/* CoC to the neighbour in 1/16 px, or how the surface ends; a byte. */
static inline uint edge_code(const __global float *inv_depth, LightfieldSize size, LightfieldLens lens, int m, int x,
                             int y, int dx, int dy, float c)
{
    const float d = edge_of(inv_depth, size, lens, m, x, y, dx, dy, c);
    if (d == MAXFLOAT) return end_code(inv_depth, size, lens, m, x, y, dx, dy, c);
    return (uint)(int)(d * EDGE_STEPS + (d < 0.0f ? -0.5f : 0.5f)) & 255u;
}

static inline int is_glass(const __global float *color, LightfieldSize size, int m, int x, int y)
{
    const float a = color[(((size_t)m * size.height + y) * size.width + x) * 4 + 3];
    return a > 0.0f && a < OPAQUE_ALPHA;
}

/* Nothing at all: hides nothing, whatever its depth. */
static inline int is_clear(const __global float *rgba) { return rgba[0] + rgba[1] + rgba[2] + rgba[3] <= 0.0f; }

/* LANES inverse depths of a row from x on (a multiple of LANES), and those one pixel to the left and right. */
static inline floatn depths_at(const __global float *inv_depth, LightfieldSize size, int m, int x, int y)
{
    if (y < 0 || y >= size.height) return (floatn)(EMPTY);
    return load_lanes(inv_depth + ((size_t)m * size.height + y) * size.pitch + x);
}

static inline floatn depths_left(const __global float *inv_depth, LightfieldSize size, int m, int x, int y, floatn w)
{
    const float edge = x > 0 ? inv_depth[((size_t)m * size.height + y) * size.pitch + x - 1] : EMPTY;
    return lanes_after(edge, w);
}

static inline floatn depths_right(const __global float *inv_depth, LightfieldSize size, int m, int x, int y, floatn w)
{
    const float edge = x + LANES < size.pitch && y >= 0 && y < size.height
                           ? inv_depth[((size_t)m * size.height + y) * size.pitch + x + LANES] : EMPTY;
    return lanes_before(w, edge);
}

static inline floatn coc_of_lanes(floatn w, LightfieldLens lens)
{
    floatn c = lens.c1 * w + lens.c0;
    c = c < -MAX_COC_PX ? (floatn)(-MAX_COC_PX) : c;
    return c > MAX_COC_PX ? (floatn)(MAX_COC_PX) : c;
}

/* lightfield_tiles: range of the inverse depth of each tile, and whether the first peel is one surface there.
 * reads   inv_depth  float[peels][height][pitch]     1/m
 *         color      float[peels][height][width][4]  alpha, with LIGHTFIELD_GLASS
 * writes  tiles  float2[peels][tiles_y][tiles_x]  (smallest, largest); of the first peel (-1, -1) where it has edges,
 *                                                 holes or glass; (0, -1) where a peel is empty
 * range   2-D, one item per tile of a peel: (tiles_x, peels * tiles_y), any local size */
__kernel void lightfield_tiles(__global float2 *restrict tiles, const __global float *restrict inv_depth,
                               const __global float *restrict color, LightfieldSize size, LightfieldLens lens)
{
    const int tx = get_global_id(0), line = get_global_id(1);
    if (tx >= size.tiles_x || line >= size.peels * size.tiles_y) return;
    const int m = line / size.tiles_y, x0 = tx * TILE, y0 = line % size.tiles_y * TILE;
    const int x1 = x0 + TILE < size.width ? x0 + TILE : size.width;
    const int y1 = y0 + TILE < size.height ? y0 + TILE : size.height;
    const __global float *peel = inv_depth + (size_t)m * size.height * size.pitch;
    const float same = SAME_SURFACE_PX / (absolute_of(lens.c1) + 1e-30f);
    float low = MAXFLOAT, high = EMPTY;
    int is_open = 0;
    for (int y = y0; y < y1; y++)
        for (int x = x0; x < x1; x++) {
            const __global float *at = peel + (size_t)y * size.pitch + x;
            const float w = *at;
            if (w >= 0.0f) {
                low = w < low ? w : low;
                high = w > high ? w : high;
            }
            if (m == 0) {
                is_open |= w < 0.0f;
                if (x + 1 < size.width) is_open |= absolute_of(at[1] - w) > same;
                if (y + 1 < size.height) is_open |= absolute_of(at[size.pitch] - w) > same;
#if LIGHTFIELD_GLASS
                is_open |= is_glass(color, size, 0, x, y);
#endif
            }
        }
    low = high < 0.0f ? 0.0f : low;
    tiles[line * size.tiles_x + tx] = is_open ? (float2)(EMPTY) : (float2)(low, high);
}

/* lightfield_cull: tiles that the first peel hides from all of the lens.
 * A nearer surface without edges hides what is behind it as far as it moves against it: over a distance that it itself
 * spans in every direction.
 * reads   tiles      float2[peels][tiles_y][tiles_x]
 * writes  tile_open  uchar[peels][tiles_y][tiles_x]  0: no view can see the peel there
 * range   2-D, one item per tile of a peel: (tiles_x, peels * tiles_y), any local size */
__kernel void lightfield_cull(__global uchar *restrict tile_open, const __global float2 *restrict tiles,
                              LightfieldSize size, LightfieldLens lens)
{
    const int tx = get_global_id(0), line = get_global_id(1);
    if (tx >= size.tiles_x || line >= size.peels * size.tiles_y) return;
    const float2 own = tiles[line * size.tiles_x + tx];
    const int ty = line % size.tiles_y;
    int is_hidden = line >= size.tiles_y && own.y < 0.0f;
    float2 front = (float2)(MAXFLOAT, EMPTY);
    for (int ring = 0; line >= size.tiles_y && ring <= CULL_RINGS && !is_hidden; ring++) {
        int is_closed = tx >= ring && ty >= ring && tx + ring < size.tiles_x && ty + ring < size.tiles_y;
        for (int j = -ring; j <= ring && is_closed; j++)
            for (int i = -ring; i <= ring && is_closed; i += j == -ring || j == ring ? 1 : 2 * ring) {
                const float2 other = tiles[(ty + j) * size.tiles_x + tx + i];
                is_closed = other.y >= 0.0f && other.x > own.y;
                front.x = other.x < front.x ? other.x : front.x;
                front.y = other.y > front.y ? other.y : front.y;
            }
        if (!is_closed) break;
        /* 3 px for the reach of footprints. */
        is_hidden = absolute_of(lens.c1) * (front.y - own.x) + 3.0f <= (float)(ring * TILE);
    }
    tile_open[line * size.tiles_x + tx] = !is_hidden;
}

static inline intn edge_codes(floatn d)
{
    return to_intn(d * EDGE_STEPS + (d < 0.0f ? (floatn)(-0.5f) : (floatn)(0.5f)));
}

/* lightfield_slots: the slots of a row of a peel that any view can see, packed to the front.
 * reads   inv_depth  float[peels][height][pitch]     1/m
 *         color      float[peels][height][width][4]  alpha, with LIGHTFIELD_GLASS
 *         tile_open  uchar[peels][tiles_y][tiles_x]
 *         gaps       ushort[][]  px from a tile of the frame to the nearest that is asked for; with LIGHTFIELD_SPARSE
 * writes  slot_at    uint[peels][height][pitch]   where in inv_depth the slot stands
 *         slot_key   uint[peels][height][pitch]   depth_key
 *         slot_coc   float[peels][height][pitch]  CoC in 1/256 px
 *         slot_edge  uint[peels][height][pitch]   4 bytes: left, right, upper, lower edge; see edge_code
 *         slot_plane uchar[peels][height][pitch]  with LIGHTFIELD_GLASS
 *         slot_count int[peels][height]
 *         cells      uchar[peels][height][pitch]  1: the pixel and those right, below and both are one surface
 * range   1-D, one item per row of a peel, any local size */
__kernel void lightfield_slots(__global uint *restrict slot_at, __global uint *restrict slot_key,
                               __global float *restrict slot_coc, __global uint *restrict slot_edge,
                               __global uchar *restrict slot_plane, __global int *restrict slot_count,
                               __global uchar *restrict cells, const __global float *restrict inv_depth,
                               const __global float *restrict color, const __global uchar *restrict tile_open,
                               GAPS_PARAM LightfieldSize size, LightfieldLens lens)
{
    const int line = get_global_id(0);
    if (line >= size.peels * size.height) return;
    const int m = line / size.height, y = line % size.height;
    const size_t row = (size_t)line * size.pitch, peel = (size_t)size.height * size.pitch;
    const __global uchar *open = tile_open + (m * size.tiles_y + y / TILE) * size.tiles_x;
    int count = 0;
    for (int x0 = 0; x0 < size.pitch; x0 += LANES) {
        const floatn w = depths_at(inv_depth, size, m, x0, y), c = coc_of_lanes(w, lens);
        const floatn above = depths_at(inv_depth, size, m, x0, y - 1);
        const floatn below = depths_at(inv_depth, size, m, x0, y + 1);
        const floatn left = depths_left(inv_depth, size, m, x0, y, w);
        const floatn right = depths_right(inv_depth, size, m, x0, y, w);
        const floatn diagonal = depths_right(inv_depth, size, m, x0, y + 1, below);
        const floatn c_right = coc_of_lanes(right, lens), c_below = coc_of_lanes(below, lens);
        const floatn d_left = coc_of_lanes(left, lens) - c, d_right = c_right - c;
        const floatn d_above = coc_of_lanes(above, lens) - c, d_below = c_below - c;
        const intn is_here = w >= 0.0f;
        const floatn similar = SIMILAR_PX + SIMILAR_SHARE * absolute(c);
        const intn is_cell = is_here & (right >= 0.0f) & (below >= 0.0f) & (diagonal >= 0.0f)
                              & (absolute(d_right) <= similar) & (absolute(d_below) <= similar)
                              & (absolute(coc_of_lanes(diagonal, lens) - c) <= similar);
        for (int i = 0; i < LANES; i++) {
            int flag = ((const int *)&is_cell)[i] ? 1 : 0;
#if LIGHTFIELD_GLASS
            if (flag) { /* so x0 + i and y are not the last */
                const __global float *alpha = color + (((size_t)line * size.width) + x0 + i) * 4 + 3;
                const int kind = alpha[0] >= OPAQUE_ALPHA;
                const int below_at = size.width * 4;
                flag = (alpha[4] >= OPAQUE_ALPHA) == kind && (alpha[below_at] >= OPAQUE_ALPHA) == kind
                       && (alpha[below_at + 4] >= OPAQUE_ALPHA) == kind;
            }
#endif
            cells[row + x0 + i] = (uchar)flag;
        }
        int is_open = 0;
        for (int t = x0 / TILE; t <= (x0 + LANES - 1) / TILE && t < size.tiles_x; t++) is_open |= open[t];
        if (!is_open) continue;
#if LIGHTFIELD_SPARSE
        const intn arrives = absolute(c) + FOOTPRINT_PX >= (float)gaps_of_row(gaps, size, y)[x0 / GAP_TILE];
        if (!any_lane(arrives)) continue;
#endif
        const intn is_plain = is_here & (left >= 0.0f) & (right >= 0.0f) & (above >= 0.0f) & (below >= 0.0f)
                               & (absolute(d_left) <= SAME_SURFACE_PX) & (absolute(d_right) <= SAME_SURFACE_PX)
                               & (absolute(d_above) <= SAME_SURFACE_PX) & (absolute(d_below) <= SAME_SURFACE_PX);
        const intn edges = (edge_codes(d_left) & 255) | (edge_codes(d_right) & 255) << 8
                            | (edge_codes(d_above) & 255) << 16 | edge_codes(d_below) << 24;
        for (int i = 0; i < LANES && x0 + i < size.width; i++) {
            const int x = x0 + i;
            const float depth = ((const float *)&w)[i];
            if (depth < 0.0f || !open[x / TILE]) continue;
#if LIGHTFIELD_SPARSE
            if (!((const int *)&arrives)[i]) continue;
#endif
#if LIGHTFIELD_VOID
            if (depth > 0.0f && is_clear(color + ((size_t)line * size.width + x) * 4)) continue;
#endif
            /* The void behind a surface is the same for every peel; what is behind glass at infinity is not void. */
            if (m > 0 && depth == 0.0f && inv_depth[row - peel + x] == 0.0f
#if LIGHTFIELD_GLASS
                && !is_glass(color, size, m - 1, x, y)
#endif
            )
                continue;
            const float coc = ((const float *)&c)[i];
            const size_t to = row + count++;
            slot_at[to] = (uint)(row + x);
            slot_key[to] = depth_key(depth);
            slot_coc[to] = coc * SUB;
            uint edge = ((const uint *)&edges)[i];
#if LIGHTFIELD_SUPPORT == 3
            if (!((const int *)&is_plain)[i])
                edge = edge_code(inv_depth, size, lens, m, x, y, -1, 0, coc)
                     | edge_code(inv_depth, size, lens, m, x, y, 1, 0, coc) << 8
                     | edge_code(inv_depth, size, lens, m, x, y, 0, -1, coc) << 16
                     | edge_code(inv_depth, size, lens, m, x, y, 0, 1, coc) << 24;
#endif
            slot_edge[to] = edge;
#if LIGHTFIELD_GLASS
            int plane = 0;
            if (is_glass(color, size, m, x, y)) {
                for (int k = m; k < size.peels; k++) plane += is_glass(color, size, k, x, y);
                plane = plane < size.planes ? plane : size.planes - 1;
            }
            slot_plane[to] = (uchar)plane;
#endif
        }
    }
    slot_count[line] = count;
}

/* Pixels [first, end) of a view's row or column that a slot covers; position in 1/256 px. */
#define SPAN(INT, first, end, at, low, high)                                                                          \
    INT first, end;                                                                                                   \
    if (LIGHTFIELD_SUPPORT == 0) {                                                                                    \
        first = ((at) + 128) >> 8;                                                                                    \
        end = first + 1;                                                                                              \
    } else if (LIGHTFIELD_SUPPORT == 1) {                                                                             \
        first = (at) >> 8;                                                                                            \
        end = ((at) + 511) >> 8;                                                                                      \
    } else if (LIGHTFIELD_SUPPORT == 2) {                                                                             \
        first = ((at) - 128) >> 8;                                                                                    \
        end = first + 3;                                                                                              \
    } else {                                                                                                          \
        first = ((at) + 127 - (low)) >> 8;                                                                            \
        end = ((at) + 383 + (high)) >> 8;                                                                             \
    }


/* How far an edge lies beyond the pixel's own half: it goes half-way to the neighbour, v * d / 2 = v * q * 8. Where the
 * surface ends at a known place, varying the place of the sample would only blur what is known: it is taken back. */
#define EDGE_REACH(q, moved, shear, place)                                                                            \
    (IS_END(q) ? END_REACH(END_LEVEL(q), place) : (moved) + (shear) + EDGE_OVERLAP)
#define END_REACH(level, place)                                                                                       \
    ((level) == 0 ? 0 : (level) * END_STEP + ((level) < 0 ? END_STEP / 2 : -END_STEP / 2) + (place))
#define EDGE_BYTE(edge, shift) ((edge) << (24 - (shift)) >> 24)
#define IS_END(q) ((q) >= END_CODE - END_LEVELS || (q) <= END_LEVELS - END_CODE)
#define END_LEVEL(q) (((q) & 255) - END_CODE)
#define KNOWN_EDGE(q) (IS_END(q) ? 0 : (q) < 0 ? -(q) : (q))
#define LARGER(a, b) ((a) > (b) ? (a) : (b))

/* Pixels of the view that slots cover: columns x0 to before x1, rows y0 to before y1. Rows and columns of a slope shear
 * against each other; the widest edge across covers what opens between them. INT is int or intn. */
#define FOOTPRINT(INT, TO_INT, TO_FLOAT, column, row_y, coc, edge, v)                                                 \
    const INT at_x = ((column) << 8) + TO_INT((coc) * (v).x) + (int)(v).z;                                            \
    const INT at_y = ((row_y) << 8) + TO_INT((coc) * (v).y) + (int)(v).w;                                             \
    const INT l = EDGE_BYTE(edge, 0), r = EDGE_BYTE(edge, 8), u = EDGE_BYTE(edge, 16), d = EDGE_BYTE(edge, 24);       \
    const float slope_x = 8.0f * (v).x, slope_y = 8.0f * (v).y;                                                       \
    const INT shear_x = TO_INT(TO_FLOAT(LARGER(KNOWN_EDGE(u), KNOWN_EDGE(d))) * absolute_of(slope_x));                   \
    const INT shear_y = TO_INT(TO_FLOAT(LARGER(KNOWN_EDGE(l), KNOWN_EDGE(r))) * absolute_of(slope_y));                   \
    const int place_x = (int)(v).z, place_y = (int)(v).w;                                                             \
    SPAN(INT, x0, x1, at_x, EDGE_REACH(l, -TO_INT(TO_FLOAT(l) * slope_x), shear_x, place_x),                          \
         EDGE_REACH(r, TO_INT(TO_FLOAT(r) * slope_x), shear_x, -place_x))                                             \
    SPAN(INT, y0, y1, at_y, EDGE_REACH(u, -TO_INT(TO_FLOAT(u) * slope_y), shear_y, place_y),                          \
         EDGE_REACH(d, TO_INT(TO_FLOAT(d) * slope_y), shear_y, -place_y))

static inline intn load_ints(const __global uint *p) { return as_intn(load_lanes((const __global float *)p)); }

/* lightfield_views: the nearest slot of every pixel of a view. The form for CPUs.
 * source  Yu, Wang & Yu 2010, section 3.2, eq. 4
 * reads   slot_*   see lightfield_slots
 *         views    float4[]  see LightfieldView
 *         gaps     see lightfield_slots; pixels that are not asked for are left undefined
 * writes  winners  ulong[views][planes][out_height][out_pitch]  columns from out_width on are left alone
 * range   2-D, one item per view and band of band_rows rows, any local size */
__kernel void lightfield_views(__global ulong *restrict winners, const __global uint *restrict slot_at,
                               const __global uint *restrict slot_key, const __global float *restrict slot_coc,
                               const __global uint *restrict slot_edge, const __global uchar *restrict slot_plane,
                               const __global int *restrict slot_count, const __global LightfieldView *restrict views,
                               GAPS_PARAM LightfieldSize size, LightfieldLens lens, int first_view, int band_rows)
{
    const int view = get_global_id(0);
    const int top = (int)get_global_id(1) * band_rows;
    if (top >= size.out_height) return;
    const int bottom = top + band_rows < size.out_height ? top + band_rows : size.out_height;
    const LightfieldView v = views[first_view + view];
    const size_t plane_size = (size_t)size.out_height * size.out_pitch;
    __global ulong *own = winners + (size_t)view * size.planes * plane_size;

    for (int p = 0; p < size.planes; p++)
        for (int y = top; y < bottom; y++) {
            __global ulong *row = own + p * plane_size + (size_t)y * size.out_pitch;
#if LIGHTFIELD_SPARSE
            const __global ushort *row_gaps = gaps_of_row(gaps, size, y + size.guard);
            for (int first = 0; first < size.out_width; first += SEGMENT) {
                const int end = first + SEGMENT < size.out_width ? first + SEGMENT : size.out_width;
                if (!is_asked_for(row_gaps, first + size.guard, end + size.guard)) continue;
                for (int x = first; x < end; x++) row[x] = ~0ul;
            }
#else
            for (int x = 0; x < size.out_width; x++) row[x] = ~0ul;
#endif
        }

    const int first_row = top + size.guard - lens.reach, end_row = bottom + size.guard + lens.reach;
    for (int y = first_row < 0 ? 0 : first_row; y < end_row && y < size.height; y++) {
        for (int m = 0; m < size.peels; m++) {
            const int line = m * size.height + y;
            const int count = slot_count[line];
            const size_t row = (size_t)line * size.pitch;
            for (int b = 0; b < count; b += LANES) {
                const intn at = load_ints(slot_at + row + b), edge = load_ints(slot_edge + row + b);
                const floatn coc = load_lanes(slot_coc + row + b);
                const intn column = at - (int)row - size.guard;
                FOOTPRINT(intn, to_intn, to_floatn, column, (intn)(y - size.guard), coc, edge, v)
                const intn lefts = LARGER(x0, 0), rights = x1 < size.out_width ? x1 : size.out_width;
                const intn uppers = LARGER(y0, top), lowers = y1 < bottom ? y1 : bottom;
                const intn is_pixel = (rights - lefts == 1) & (lowers - uppers == 1);
                const intn pixels = uppers * size.out_pitch + lefts;
                const int n = count - b < LANES ? count - b : LANES;
                for (int i = 0; i < n; i++) {
                    const ulong key = (ulong)slot_key[row + b + i] << 32 | slot_at[row + b + i];
#if LIGHTFIELD_GLASS
                    __global ulong *plane = own + slot_plane[row + b + i] * plane_size;
#else
                    __global ulong *plane = own;
#endif
                    if (((const int *)&is_pixel)[i]) {
                        __global ulong *to = plane + ((const int *)&pixels)[i];
                        const ulong old = *to;
                        *to = key < old ? key : old;
                        continue;
                    }
                    for (int j = ((const int *)&uppers)[i]; j < ((const int *)&lowers)[i]; j++)
                        for (int k = ((const int *)&lefts)[i]; k < ((const int *)&rights)[i]; k++) {
                            __global ulong *to = plane + (size_t)j * size.out_pitch + k;
                            if (key < *to) *to = key;
                        }
                }
            }
        }
    }
}

/* The same for devices with many threads: an item per slot and view, in its own launch whatever depends on all. */
#define FOR_PIXELS_OF_SLOT                                                                                            \
    const int view = get_global_id(1), line = (int)get_global_id(0) / size.pitch;                                     \
    if (line >= size.peels * size.height) return;                                                                     \
    const int slot = (int)get_global_id(0) % size.pitch;                                                              \
    if (slot >= slot_count[line]) return;                                                                             \
    const size_t row = (size_t)line * size.pitch;                                                                     \
    const LightfieldView v = views[first_view + view];                                                                \
    const uint at = slot_at[row + slot], key = slot_key[row + slot];                                                  \
    const int edges = (int)slot_edge[row + slot];                                                                     \
    const int plane = LIGHTFIELD_GLASS ? slot_plane[row + slot] : 0;                                                  \
    __global uint *own = winners + ((size_t)view * size.planes + plane) * size.out_height * size.out_pitch * 2;       \
    FOOTPRINT(int, (int), (float), (int)(at - row) - size.guard, line % size.height - size.guard,                     \
              slot_coc[row + slot], edges, v)                                                                         \
    for (int j = LARGER(y0, 0); j < y1 && j < size.out_height; j++)                                                   \
        for (int k = LARGER(x0, 0); k < x1 && k < size.out_width; k++)

/* lightfield_clear: holes everywhere.
 * writes  winners  uint2[views][planes][out_height][out_pitch]  low word first
 * range   1-D, one item per word, any local size */
__kernel void lightfield_clear(__global uint *restrict winners, uint words)
{
    if (get_global_id(0) < words) winners[get_global_id(0)] = NONE;
}

/* lightfield_depths: the nearest depth of every pixel of every view.
 * source  Yu, Wang & Yu 2010, section 3.2
 * reads   slot_*, views  see lightfield_views
 * updates winners  the high words
 * range   2-D, (peels * height * pitch, views), any local size */
__kernel void lightfield_depths(__global uint *restrict winners, const __global uint *restrict slot_at,
                                const __global uint *restrict slot_key, const __global float *restrict slot_coc,
                                const __global uint *restrict slot_edge, const __global uchar *restrict slot_plane,
                                const __global int *restrict slot_count, const __global LightfieldView *restrict views,
                                LightfieldSize size, int first_view)
{
    FOR_PIXELS_OF_SLOT atomic_min(own + ((size_t)j * size.out_pitch + k) * 2 + 1, key);
}

/* lightfield_sources: of the slots that are nearest, the first in memory.
 * reads   slot_*, views  see lightfield_views
 * updates winners  the low words, from the high ones
 * range   2-D, (peels * height * pitch, views), any local size */
__kernel void lightfield_sources(__global uint *restrict winners, const __global uint *restrict slot_at,
                                 const __global uint *restrict slot_key, const __global float *restrict slot_coc,
                                 const __global uint *restrict slot_edge, const __global uchar *restrict slot_plane,
                                 const __global int *restrict slot_count, const __global LightfieldView *restrict views,
                                 LightfieldSize size, int first_view)
{
    FOR_PIXELS_OF_SLOT
    {
        __global uint *to = own + ((size_t)j * size.out_pitch + k) * 2;
        if (to[1] == key) atomic_min(to, at);
    }
}

#if LIGHTFIELD_PACKED
#pragma OPENCL EXTENSION cl_khr_int64_extended_atomics : enable
/* lightfield_packed: both steps in one, by 64-bit atomics.
 * reads   slot_*, views  see lightfield_views
 * updates winners
 * range   2-D, (peels * height * pitch, views), any local size */
__kernel void lightfield_packed(__global uint *restrict winners, const __global uint *restrict slot_at,
                                const __global uint *restrict slot_key, const __global float *restrict slot_coc,
                                const __global uint *restrict slot_edge, const __global uchar *restrict slot_plane,
                                const __global int *restrict slot_count, const __global LightfieldView *restrict views,
                                LightfieldSize size, int first_view)
{
    FOR_PIXELS_OF_SLOT
        atom_min((volatile __global ulong *)own + (size_t)j * size.out_pitch + k, (ulong)key << 32 | at);
}
#endif

/* Whether two inverse depths are near enough for their colours to be mixed; c is the CoC of w. */
static inline int is_similar(float other, float w, float c, LightfieldLens lens)
{
    return other >= 0.0f && absolute_of(lens.c1) * absolute_of(other - w) <= SIMILAR_PX + SIMILAR_SHARE * absolute_of(c);
}

/* Glass and what is not are never mixed: an opaque surface would let light through. */
static inline int is_same_kind(float4 a, float4 b)
{
    return LIGHTFIELD_GLASS == 0 || (a.w >= OPAQUE_ALPHA) == (b.w >= OPAQUE_ALPHA);
}

/* Colour of a ray between pixels that may belong to several surfaces: bilinear, with those of another surface replaced
 * by ones that are not. (ray_x, ray_y) in 1/256 px is where it meets the reference view, (x, y) the winner there. */
static inline float4 edge_color(const __global float *color, const __global float *inv_depth, LightfieldSize size,
                                LightfieldLens lens, int m, int x, int y, int ray_x, int ray_y, float w, float c)
{
    const __global float *own = color + (((size_t)m * size.height + y) * size.width + x) * 4;
    const __global float *depth = inv_depth + ((size_t)m * size.height + y) * size.pitch + x;
    const int step_x = ray_x < x << 8 ? -1 : 1, step_y = ray_y < y << 8 ? -1 : 1;
    const int dx = step_x * (ray_x - (x << 8)), dy = step_y * (ray_y - (y << 8));
    const int in_x = x + step_x >= 0 && x + step_x < size.width, in_y = y + step_y >= 0 && y + step_y < size.height;
    const float4 base = load_pixel(own);
    const long row = (long)step_y * size.width * 4;
    const int has_x = in_x && is_similar(depth[step_x], w, c, lens);
    const int has_y = in_y && is_similar(depth[step_y * size.pitch], w, c, lens);
    const int has_both = in_x && in_y && is_similar(depth[step_y * size.pitch + step_x], w, c, lens);
    float4 beside = has_x ? load_pixel(own + step_x * 4) : base;
    float4 next = has_y ? load_pixel(own + row) : base;
    beside = is_same_kind(beside, base) ? beside : base;
    next = is_same_kind(next, base) ? next : base;
    float4 across = has_both ? load_pixel(own + row + step_x * 4) : has_y ? next : beside;
    across = is_same_kind(across, base) ? across : base;
    const float fx = (float)(dx < 256 ? dx : 256) * (1.0f / SUB), fy = (float)(dy < 256 ? dy : 256) * (1.0f / SUB);
    const float4 one = base + fx * (beside - base), two = next + fx * (across - next);
    return one + fy * (two - one);
}

/* Colour of a random pixel of the winner's surface in the ray's share of the lens. */
static inline float4 jittered_color(const __global float *color, const __global float *inv_depth, LightfieldSize size,
                                    LightfieldLens lens, int m, int x, int y, int ray_x, int ray_y, float w, float c,
                                    uint seed)
{
    const float4 base = load_pixel(color + (((size_t)m * size.height + y) * size.width + x) * 4);
    const float width = 2.0f * absolute_of(c) * lens.cell;
    seed = (seed ^ seed >> 16) * 0x7feb352du;
    seed = (seed ^ seed >> 15) * 0x846ca68bu;
    seed ^= seed >> 16;
    const float dx = ((float)(seed & 0xffffu) * (1.0f / 65535.0f) - 0.5f) * width;
    const float dy = ((float)(seed >> 16) * (1.0f / 65535.0f) - 0.5f) * width;
    const int jx = (ray_x + (int)(dx * SUB) + 128) >> 8, jy = (ray_y + (int)(dy * SUB) + 128) >> 8;
    if (jx >= 0 && jx < size.width && jy >= 0 && jy < size.height
        && is_similar(inv_depth[((size_t)m * size.height + jy) * size.pitch + jx], w, c, lens)) {
        const float4 found = load_pixel(color + (((size_t)m * size.height + jy) * size.width + jx) * 4);
        if (is_same_kind(found, base)) return found;
    }
    return base;
}

/* What look-ups take if there is a pyramid, and if rays are shaded. */
#define MIP_PARAMS
#define MIP_ARGS
#define SHADE_PARAMS
#define SHADE_ARGS
#if LIGHTFIELD_SHADED
#undef SHADE_PARAMS
#undef SHADE_ARGS
#define SURFACE_PLANES 7 /* as shading_split writes them */
#define SHADE_PARAMS                                                                                                  \
    , const __global float *surface, const __global float4 *lighting, const __global float4 *environment, float4 eye
#define SHADE_ARGS , surface, lighting, environment, eye
#endif

#if LIGHTFIELD_LEVELS
#undef MIP_PARAMS
#undef MIP_ARGS
#define MIP_PARAMS , const __global float *mips, const __global float *mip_depths, const __global int4 *mip_table
#define MIP_ARGS , mips, mip_depths, mip_table

/* Colour from the pyramid, bilinear between what is of the winner's surface; .w of the result is -1 if nothing is. */
static inline float4 mip_color(const __global float *mips, const __global float *mip_depths, int4 size,
                               LightfieldLens lens, int level, int m, int ray_x, int ray_y, float w, float c,
                               float4 base)
{
    const int width = size.x, height = size.y;
    const size_t first = size.z + (size_t)m * width * height;
    const float scale = 1.0f / (SUB * (float)(1 << level));
    const float x = (float)ray_x * scale, y = (float)ray_y * scale; /* texel i stands on pixel i * 2^level */
    const int x0 = (int)(x < 0.0f ? 0.0f : x), y0 = (int)(y < 0.0f ? 0.0f : y);
    const float fx = x - (float)x0, fy = y - (float)y0;
    float4 sum = (float4)(0.0f);
    float weights = 0.0f;
    for (int j = 0; j < 2; j++)
        for (int i = 0; i < 2; i++) {
            const size_t at = first + (size_t)clamp_index(y0 + j, height - 1) * width + clamp_index(x0 + i, width - 1);
            const float weight = (i ? fx : 1.0f - fx) * (j ? fy : 1.0f - fy);
            if (!(weight > 0.0f) || !is_similar(mip_depths[at], w, c, lens)) continue;
            const float4 texel = load_pixel(mips + at * 4);
            if (!is_same_kind(texel, base)) continue;
            sum += weight * texel;
            weights += weight;
        }
    return weights > 0.0625f ? sum * (1.0f / weights) : (float4)(-1.0f);
}
#endif

/* One texel of a level from the one below, which is twice as fine. */
static inline void shrink(__global float *to_color, __global float *to_depth, const __global float *color,
                          const __global float *depth, LightfieldLens lens, int x, int y, int width, int height,
                          int pitch)
{
    const float w = depth[(size_t)2 * y * pitch + 2 * x], c = coc_of(w, lens);
    const float4 base = load_pixel(color + ((size_t)2 * y * width + 2 * x) * 4);
    float4 sum = (float4)(0.0f);
    float weights = 0.0f;
    for (int j = -1; j <= 1; j++)
        for (int i = -1; i <= 1; i++) {
            const int u = clamp_index(2 * x + i, width - 1), v = clamp_index(2 * y + j, height - 1);
            if (!is_similar(depth[(size_t)v * pitch + u], w, c, lens)) continue;
            const float4 texel = load_pixel(color + ((size_t)v * width + u) * 4);
            if (!is_same_kind(texel, base)) continue;
            const float weight = (i ? 0.25f : 0.5f) * (j ? 0.25f : 0.5f);
            sum += weight * texel;
            weights += weight;
        }
    store_pixel(to_color, weights > 0.0f ? sum * (1.0f / weights) : (float4)(0.0f));
    *to_depth = w;
}

/* lightfield_shrink: the first level of the pyramid.
 * source  Yu, Wang & Yu 2010, section 4.2: a 3x3 Gaussian. Only pixels of the middle one's surface count, so that no
 *         light leaks across silhouettes.
 * reads   color      float[peels][height][width][4]
 *         inv_depth  float[peels][height][pitch]
 * writes  mips       float[peels][(height+1)/2][(width+1)/2][4]
 *         mip_depths float[peels][(height+1)/2][(width+1)/2]
 * range   2-D, one item per texel: (columns, peels * rows), any local size */
__kernel void lightfield_shrink(__global float *restrict mips, __global float *restrict mip_depths,
                                const __global float *restrict color, const __global float *restrict inv_depth,
                                LightfieldSize size, LightfieldLens lens)
{
    const int width = (size.width + 1) / 2, height = (size.height + 1) / 2;
    const int x = get_global_id(0), line = get_global_id(1);
    if (x >= width || line >= size.peels * height) return;
    const size_t to = (size_t)line * width + x, peel = (size_t)(line / height) * size.height;
    shrink(mips + to * 4, mip_depths + to, color + peel * size.width * 4, inv_depth + peel * size.pitch, lens, x,
           line % height, size.width, size.height, size.pitch);
}

/* lightfield_shrink_again: a further level, from the one of width x height that starts at `first` to `next`.
 * updates mips, mip_depths  see lightfield_shrink
 * range   2-D, one item per texel: (columns, peels * rows), any local size */
__kernel void lightfield_shrink_again(__global float *mips, __global float *mip_depths, LightfieldLens lens, int peels,
                                      int width, int height, int first, int next)
{
    const int columns = (width + 1) / 2, rows = (height + 1) / 2;
    const int x = get_global_id(0), line = get_global_id(1);
    if (x >= columns || line >= peels * rows) return;
    const size_t to = next + (size_t)line * columns + x, peel = first + (size_t)(line / rows) * width * height;
    shrink(mips + to * 4, mip_depths + to, mips + peel * 4, mip_depths + peel, lens, x, line % rows, width, height,
           width);
}

/* Colour of a ray that no plain cell holds, or that is wide. */
static inline float4 ray_color(const __global float *color, const __global float *inv_depth, LightfieldSize size,
                               LightfieldLens lens, uint at, int ray_x, int ray_y, float w, float c,
                               uint seed MIP_PARAMS)
{
    const int line = at / (uint)size.pitch, x = at - line * size.pitch;
    const int m = line / size.height, y = line - m * size.height;
#if LIGHTFIELD_LEVELS
    const float width = absolute_of(c) * lens.cell;
    const float4 base = LIGHTFIELD_GLASS ? load_pixel(color + ((size_t)line * size.width + x) * 4) : (float4)(1.0f);
    int level = 0;
    /* The nearest whole level: log2(width) rounded. */
    for (float step = 1.41421356f; level < LIGHTFIELD_LEVELS && width >= step; step *= 2.0f) level++;
    for (; level > 0; level--) {
        const float4 wide = mip_color(mips, mip_depths, mip_table[level - 1], lens, level, m, ray_x, ray_y, w, c, base);
        if (wide.w >= 0.0f) return wide;
    }
#endif
#if LIGHTFIELD_LOOKUP == 2
    return jittered_color(color, inv_depth, size, lens, m, x, y, ray_x, ray_y, w, c, seed);
#elif LIGHTFIELD_LOOKUP == 1
    return edge_color(color, inv_depth, size, lens, m, x, y, ray_x, ray_y, w, c);
#else
    return load_pixel(color + ((size_t)line * size.width + x) * 4);
#endif
}

#if LIGHTFIELD_SHADED
static inline int is_run(intn at)
{
    const intn off = at - at.s0 - LANE_INDEX;
    return !any_lane(off);
}

static inline floatn between(floatn a, floatn b, floatn c, floatn d, floatn fx, floatn fy)
{
    const floatn above = a + fx * (b - a), below = c + fx * (d - c);
    return above + fy * (below - above);
}

/* What LANES rays find mirrored where they hit, from the surface buffers: normals between the corners of a cell that
 * is one surface, everything else at the winner. Without that, curved things mirror in facets of a pixel each.
 * `at` and `cell` are places of winners and cells, `peel_at` where their peel starts; is_cell: -1 where a cell is one
 * surface. */
static inline void mirrored(float4 found[LANES], const uint2 hits[LANES], int end, intn at, intn cell, intn peel_at,
                            intn is_cell, int peel, int pitch, intn ray_x, intn ray_y, floatn fx, floatn fy,
                            floatn w SHADE_PARAMS)
{
    floatn normal[3], rest[SURFACE_PLANES - 3];
    if (end == LANES && !any_lane(~is_cell) && is_run(at) && is_run(cell)) {
        const __global float *base = surface + (size_t)(SURFACE_PLANES - 1) * peel_at.s0;
        for (int p = 0; p < 3; p++) {
            const __global float *n = base + (size_t)p * peel + cell.s0;
            normal[p] = between(load_lanes(n), load_lanes(n + 1), load_lanes(n + pitch), load_lanes(n + pitch + 1), fx, fy);
        }
        for (int p = 3; p < SURFACE_PLANES; p++) rest[p - 3] = load_lanes(base + (size_t)p * peel + at.s0);
    } else {
        floatn corner[3][4];
        for (int i = 0; i < LANES; i++) {
            const int is_hit = i < end && hits[i].x != NONE, is_smooth = ((const int *)&is_cell)[i];
            const __global float *base = surface
                                         + (is_hit ? (size_t)(SURFACE_PLANES - 1) * ((const int *)&peel_at)[i] : 0);
            const int own = is_hit ? ((const int *)&at)[i] : 0, first = is_smooth ? ((const int *)&cell)[i] : own;
            const int across = is_smooth ? 1 : 0, down = is_smooth ? pitch : 0;
            for (int p = 0; p < 3; p++) {
                const __global float *n = base + (size_t)p * peel + first;
                ((float *)&corner[p][0])[i] = n[0];
                ((float *)&corner[p][1])[i] = n[across];
                ((float *)&corner[p][2])[i] = n[down];
                ((float *)&corner[p][3])[i] = n[down + across];
            }
            for (int p = 3; p < SURFACE_PLANES; p++)
                ((float *)&rest[p - 3])[i] = is_hit ? base[(size_t)p * peel + own] : 0.0f;
        }
        for (int p = 0; p < 3; p++) normal[p] = between(corner[p][0], corner[p][1], corner[p][2], corner[p][3], fx, fy);
    }
    if (!(sum_lanes(rest[0] + rest[1] + rest[2]) > 0.0f)) return;
    const floatn square = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
    const floatn unit = square > 1e-12f ? shading_rsqrt(square) : (floatn)(0.0f);
    const Shading3 position = shading_position(lighting, to_floatn(ray_x) * (1.0f / SUB) + 0.5f,
                                               to_floatn(ray_y) * (1.0f / SUB) + 0.5f, w);
    const Shading3 n = shading_3(normal[0] * unit, normal[1] * unit, normal[2] * unit);
    const Shading3 light = shading_specular(position, n, shading_3(rest[0], rest[1], rest[2]), rest[3], eye, lighting,
                                            environment);
    for (int i = 0; i < end; i++) {
        if (hits[i].x == NONE) continue;
        const float4 more = (float4)(((const float *)&light.x)[i], ((const float *)&light.y)[i],
                                     ((const float *)&light.z)[i], 0.0f);
        found[i] += found[i].w * more;
    }
}
#endif

/* Whether a ray that is at (x, y) in focus, in px, and hits inverse depth w has come in over an edge of the layers on
 * its way, behind an opaque surface that the layers end in there. That surface goes on outside, nobody knows how far, and what
 * is behind it was not to be seen: the ray says nothing, as where a view has a hole. Without a guard band that is what
 * surfaces that have moved off an edge leave there. */
static inline int is_beyond(const __global float *color, const __global float *inv_depth, LightfieldSize size,
                            LightfieldLens lens, float x, float y, float v_x, float v_y, float w, float c)
{
    const float hit_x = x - c * v_x, hit_y = y - c * v_y;
    const float to_x = -lens.c1 * v_x, to_y = -lens.c1 * v_y; /* px per 1/m towards the lens */
    const float room_x = to_x < 0.0f ? hit_x + 0.5f - EDGE_PX : (float)size.width - 0.5f - EDGE_PX - hit_x;
    const float room_y = to_y < 0.0f ? hit_y + 0.5f - EDGE_PX : (float)size.height - 0.5f - EDGE_PX - hit_y;
    const float speed_x = absolute_of(to_x), speed_y = absolute_of(to_y);
    const float in_x = speed_x > 1e-12f ? room_x / speed_x : MAXFLOAT;
    const float in_y = speed_y > 1e-12f ? room_y / speed_y : MAXFLOAT;
    float t = in_x < in_y ? in_x : in_y;
    t = t < 0.0f ? 0.0f : t;
    if (!(t < 1e12f)) return 0;
    const int at_x = clamp_index((int)(hit_x + t * to_x + 0.5f), size.width - 1);
    const int at_y = clamp_index((int)(hit_y + t * to_y + 0.5f), size.height - 1);
    for (int m = 0; m < size.peels; m++) {
        const size_t row = (size_t)m * size.height + at_y;
        if (inv_depth[row * size.pitch + at_x] > w + t && color[(row * size.width + at_x) * 4 + 3] >= OPAQUE_ALPHA)
            return 1;
    }
    return 0;
}

/* Colours of LANES rays of a view, side by side, from their winners; `end` of them count. (left, top) is the first
 * one's place in the reference view in 1/256 px. Holes are left as they are. False if all are holes. */
static inline int ray_colors(float4 found[LANES], uint2 hits[LANES], const __global uint2 *winners, int end,
                             const __global float *color, const __global float *inv_depth,
                             const __global uchar *cells, LightfieldSize size, LightfieldLens lens, int left, int top,
                             LightfieldView v, uint seed MIP_PARAMS SHADE_PARAMS)
{
    const float shift_x = SUB * v.x, shift_y = SUB * v.y;
    /* Addresses of all at once, colours one by one. */
    uint any = 0;
    intn key, at;
    for (int i = 0; i < end; i++) {
        hits[i] = winners[i];
        any |= hits[i].x ^ NONE;
    }
    if (!any) return 0;
    if (end == LANES) {
        const floatn low = load_lanes((const __global float *)winners);
        const floatn high = load_lanes((const __global float *)(winners + LANES / 2));
        at = as_intn((floatn)(low.even, high.even));
        key = as_intn((floatn)(low.odd, high.odd));
    } else {
        at = key = (intn)((int)NONE);
        for (int i = 0; i < end; i++) {
            ((int *)&at)[i] = (int)hits[i].x;
            ((int *)&key)[i] = (int)hits[i].y;
        }
    }
    const int peel = size.height * size.pitch, color_peel = size.height * size.width;
    const floatn w = as_floatn(~key & 0x7fffffff), c = coc_of_lanes(w, lens);
    const intn ray_x = left + (LANE_INDEX << 8) - to_intn(c * shift_x);
    const intn ray_y = top - to_intn(c * shift_y);
    const intn cell_x = ray_x >> 8, cell_y = ray_y >> 8;
    if ((left >> 8) < lens.reach || (left >> 8) + end + lens.reach > size.width || (top >> 8) < lens.reach
        || (top >> 8) + 1 + lens.reach > size.height) {
        any = 0;
        for (int i = 0; i < end; i++) {
            if (hits[i].x != NONE
                && is_beyond(color, inv_depth, size, lens, ((float)(left + (i << 8)) - v.z) * (1.0f / SUB),
                             ((float)top - v.w) * (1.0f / SUB), v.x, v.y, ((const float *)&w)[i],
                             ((const float *)&c)[i]))
                hits[i] = (uint2)(NONE);
            any |= hits[i].x ^ NONE;
        }
        if (!any) return 0;
    }
    intn peel_at = 0, color_at = 0;
    for (int m = 1; m < size.peels; m++) {
        const intn is_behind = at >= m * peel;
        peel_at = is_behind ? (intn)(m * peel) : peel_at;
        color_at = is_behind ? (intn)(m * color_peel) : color_at;
    }
    const intn cell = peel_at + cell_y * size.pitch + cell_x;
    color_at += cell_y * size.width + cell_x;
    /* The winner has to be one of the cell's four corners. */
    const intn off = at - cell;
    intn is_plain = (cell_x >= 0) & (cell_x + 1 < size.width) & (cell_y >= 0) & (cell_y + 1 < size.height)
                     & ((off == 0) | (off == 1) | (off == size.pitch) | (off == size.pitch + 1));
#if LIGHTFIELD_LEVELS
    is_plain &= absolute(c) * lens.cell < 1.41421356f;
#endif
    const floatn fx = to_floatn(ray_x & 255) * (1.0f / SUB);
    const floatn fy = to_floatn(ray_y & 255) * (1.0f / SUB);
    intn is_cell = 0;
    for (int i = 0; i < end; i++) {
        if (hits[i].x == NONE) continue;
        if (LIGHTFIELD_LOOKUP == 1 && ((const int *)&is_plain)[i] && cells[((const int *)&cell)[i]]) {
            ((int *)&is_cell)[i] = -1;
            const __global float *corner = color + (size_t)((const uint *)&color_at)[i] * 4;
            const float gx = ((const float *)&fx)[i], gy = ((const float *)&fy)[i];
            const float4 p = load_pixel(corner), q = load_pixel(corner + size.width * 4);
            const float4 above = p + gx * (load_pixel(corner + 4) - p);
            const float4 below = q + gx * (load_pixel(corner + size.width * 4 + 4) - q);
            found[i] = above + gy * (below - above);
        } else {
            found[i] = ray_color(color, inv_depth, size, lens, hits[i].x, ((const int *)&ray_x)[i],
                                 ((const int *)&ray_y)[i], ((const float *)&w)[i], ((const float *)&c)[i],
                                 seed + i MIP_ARGS);
        }
    }
#if LIGHTFIELD_SHADED
    mirrored(found, hits, end, at, cell, peel_at, is_cell, peel, size.pitch, ray_x, ray_y, fx, fy, w SHADE_ARGS);
#endif
    return 1;
}

#if LIGHTFIELD_GLASS
static inline int is_before(uint2 a, uint2 b) { return a.y < b.y || (a.y == b.y && a.x < b.x); }
#endif

#if LIGHTFIELD_SHADED
#define PINHOLE_COLOR whole_color
#else
#define PINHOLE_COLOR color
#endif
/* The layers of a pixel one over the other, for where no view has anything to say. */
static inline float4 pinhole(const __global float *color, LightfieldSize size, int x, int y)
{
    float4 sum = (float4)(0.0f);
    for (int m = 0; m < size.peels; m++)
        sum += (1.0f - sum.w) * load_pixel(color + (((size_t)m * size.height + y) * size.width + x) * 4);
    return sum;
}

/* lightfield_synthesize: the wide-aperture filter.
 * source  Yu, Wang & Yu 2010, eqs. 6-7; cos^4 as printed below eq. 7, divided by its sum
 * reads   winners    uint2[views][planes][out_height][out_pitch]
 *         color      float[peels][height][width][4]
 *         inv_depth  float[peels][height][pitch]
 *         cells      uchar[peels][height][pitch]
 *         views      LightfieldView[]
 *         gaps       see lightfield_slots
 *         mips, mip_depths  see lightfield_shrink; with LIGHTFIELD_LEVELS
 *         mip_table  int4[LIGHTFIELD_LEVELS]  width, height and first pixel, of level 1 and up
 *         surface, lighting, environment  see shading.cl; with LIGHTFIELD_SHADED, where `color` lacks what is mirrored
 *                                         and whole_color does not
 * updates sum        float[out_height][out_pitch][4]  colours so far, when not all views come at once
 *         seen       float[out_height][out_pitch]     their weights
 * writes  out        float[out_height][out_width][4]  after the last views
 * range   2-D, one item per SEGMENT pixels of a row, any local size */
__kernel void lightfield_synthesize(__global float *restrict out, __global float *restrict sum,
                                    __global float *restrict seen, const __global uint2 *restrict winners,
                                    const __global float *restrict color, const __global float *restrict inv_depth,
                                    const __global uchar *restrict cells, const __global LightfieldView *restrict views,
                                    GAPS_PARAM
#if LIGHTFIELD_LEVELS
                                    const __global float *restrict mips, const __global float *restrict mip_depths,
                                    const __global int4 *restrict mip_table,
#endif
#if LIGHTFIELD_SHADED
                                    const __global float *restrict whole_color, const __global float *restrict surface,
                                    const __global float4 *restrict lighting,
                                    const __global float4 *restrict environment,
#endif
                                    LightfieldSize size, LightfieldLens lens, int first_view, int view_count,
                                    int is_last)
{
    const int x0 = SEGMENT * (int)get_global_id(0), y = get_global_id(1);
    if (x0 >= size.out_width || y >= size.out_height) return;
    const int n = size.out_width - x0 < SEGMENT ? size.out_width - x0 : SEGMENT;
#if LIGHTFIELD_SPARSE
    const __global ushort *row_gaps = gaps_of_row(gaps, size, y + size.guard);
    if (!is_asked_for(row_gaps, x0 + size.guard, x0 + n + size.guard)) return;
#endif
    const size_t here = (size_t)y * size.out_pitch + x0, plane_size = (size_t)size.out_height * size.out_pitch;
    float4 total[SEGMENT];
    float weights[SEGMENT];
    for (int i = 0; i < n; i++) {
        total[i] = first_view ? load_pixel(sum + (here + i) * 4) : (float4)(0.0f);
        weights[i] = first_view ? seen[here + i] : 0.0f;
    }
    for (int s = 0; s < view_count; s++) {
        const LightfieldView v = views[first_view + s];
        const float tangent = 1.0f + lens.cos4 * (v.x * v.x + v.y * v.y);
        const float weight = 1.0f / (tangent * tangent);
        const __global uint2 *own = winners + (size_t)s * size.planes * plane_size + here;
        const uint seed = ((uint)(first_view + s) << 24 ^ (uint)y << 12) + (uint)x0;
#if LIGHTFIELD_SHADED
        const float4 eye = shading_eye(lighting, v.x * lens.radius, -v.y * lens.radius);
#endif
        const int left = (x0 + size.guard) << 8, top = (y + size.guard) << 8;
        for (int b = 0; b < n; b += LANES) {
            const int end = n - b < LANES ? n - b : LANES;
            float4 found[LANES];
            uint2 hits[LANES];
#define RAYS_OF(colors, winners_of, plane)                                                                            \
    ray_colors(colors, winners_of, own + (plane) * plane_size + b, end, color, inv_depth, cells, size, lens,          \
               left + (b << 8), top, v, seed + b MIP_ARGS SHADE_ARGS)
#if LIGHTFIELD_GLASS
            /* Rays that meet glass before what hides the rest: the panes over one another, then what is behind. A hole
             * behind glass counts as far as the glass covers it; or, if the frame lets the void through, as the void:
             * behind the last peel there is no slot for it. */
            float4 panes[LIGHTFIELD_GLASS + 1][LANES];
            uint2 pane_hits[LIGHTFIELD_GLASS + 1][LANES];
            int has_pane[LIGHTFIELD_GLASS + 1];
            if (!RAYS_OF(found, hits, 0))
                for (int i = 0; i < end; i++) hits[i] = (uint2)(NONE);
            for (int p = 1; p < size.planes; p++) has_pane[p] = RAYS_OF(panes[p], pane_hits[p], p);
            const float behind_glass = LIGHTFIELD_VOID ? 0.0f : MAXFLOAT; /* how opaque glass is before a hole that counts */
            for (int i = 0; i < end; i++) {
                const int is_hole = hits[i].x == NONE;
                uint2 last = (uint2)(0);
                float4 ray = (float4)(0.0f);
                for (int turn = 1; turn < size.planes; turn++) {
                    int next = 0; /* the nearest pane that comes after the last one */
                    for (int p = 1; p < size.planes; p++) {
                        if (!has_pane[p] || pane_hits[p][i].x == NONE || !is_before(pane_hits[p][i], hits[i])) continue;
                        if (turn > 1 && !is_before(last, pane_hits[p][i])) continue;
                        if (next == 0 || is_before(pane_hits[p][i], pane_hits[next][i])) next = p;
                    }
                    if (next == 0) break;
                    last = pane_hits[next][i];
                    ray += (1.0f - ray.w) * panes[next][i];
                }
                weights[b + i] += !is_hole || ray.w > behind_glass ? weight : weight * ray.w;
                if (!is_hole) ray += (1.0f - ray.w) * found[i];
                total[b + i] += weight * ray;
            }
#else
            if (!RAYS_OF(found, hits, 0)) continue;
            for (int i = 0; i < end; i++) {
                if (hits[i].x == NONE) continue;
                total[b + i] += weight * found[i];
                weights[b + i] += weight;
            }
#endif
#undef RAYS_OF
        }
    }
    for (int i = 0; i < n; i++) {
        if (!is_last) {
            store_pixel(sum + (here + i) * 4, total[i]);
            seen[here + i] = weights[i];
            continue;
        }
#if LIGHTFIELD_SPARSE
        if (row_gaps[(x0 + i + size.guard) / GAP_TILE] != 0) continue;
#endif
        float4 pixel = weights[i] > MIN_WEIGHT ? total[i] * (1.0f / weights[i])
                                               : pinhole(PINHOLE_COLOR, size, x0 + i + size.guard, y + size.guard);
        pixel.w = pixel.w < 1.0f ? pixel.w : 1.0f;
        store_pixel(out + ((size_t)y * size.out_width + x0 + i) * 4, pixel);
    }
}
