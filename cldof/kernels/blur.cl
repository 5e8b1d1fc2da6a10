/* blur.cl: Gaussian blur of an RGBA image by two engines, FIR and recursive (IIR).
 *
 * Images are float[height][pitch][4], pitch a multiple of 16 pixels and at least width; pixels from width to pitch are
 * scratch. Beyond its edges the image repeats its edge pixels, so a constant image stays constant. */

#include "common.clh"
#include "fir.clh"

/* blur_fir: both directions of a separable FIR filter in one pass.
 * source  direct convolution; the taps come from cldof.methods.gaussian.fir_taps
 * reads   image  float[height][pitch][4]
 *         taps   float[radius + 1]  from the middle outwards
 * writes  out    float[height][pitch][4], not image
 * range   2-D groups: (segments of a row, blocks of FIR_ROWS rows); local size (any, 1)
 * local   lines  float[segment + 2*halo][FIR_LINE], halo = the multiple of 4 above radius */
__kernel void blur_fir(__global float *restrict out, const __global float *restrict image,
                       const __global float *restrict taps, int width, int height, int pitch, int radius, int segment,
                       __local float *restrict lines)
{
    const int halo = (radius + 4) & ~3;
    const int line_width = segment + 2 * halo;
    const int x0 = (int)get_group_id(0) * segment;
    const int y0 = (int)get_group_id(1) * FIR_ROWS;

    for (int b = get_local_id(0); b < line_width / PIXELS; b += get_local_size(0)) {
        int x = x0 - halo + PIXELS * b;
        if (x < 0 || x >= width) continue;
        for (int row = 0; row < FIR_ROWS && y0 + row < height; row += FIR_RUN) {
            __local float *line = lines + PIXELS * b * FIR_LINE + 4 * row;
            floatn acc[FIR_RUN];
            fir_columns(acc, image, x, y0 + row, height, pitch, taps, radius);
            fir_turn(acc);
#pragma unroll
            for (int i = 0; i < FIR_RUN; i++) store_lanes_local(line + fir_place(i), acc[i]);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    fir_extend_lines(lines, line_width, x0 - halo, width);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int b = get_local_id(0); b < segment / FIR_RUN * FIR_GROUPS; b += get_local_size(0)) {
        int x = b / FIR_GROUPS * FIR_RUN, row = b % FIR_GROUPS * PIXELS;
        if (x0 + x < pitch)
            fir_store(out, lines + (x + halo) * FIR_LINE + 4 * row, x0 + x, y0 + row, height, pitch, taps, radius);
    }
}

/* The recursive engine. h(n) = sum over sections of Re(c * p^|n|), a sum of complex exponentials fitted to the Gaussian
 * (Deriche 1993, in parallel form). Each section is a one-pole recursion s = p*s + x with complex p and s, run forwards
 * and backwards over the same input; in float32 this form stays within 1e-6 of float64 up to sigma 200, where the
 * usual fourth-order direct form overflows. The backward sweep leaves the middle tap to the forward one.
 *
 * The tails of a blurred image that is nowhere negative would still swing around 0 by what rounding and the fit leave,
 * which shows where a lamp is a million times as bright: they are cut at 0.
 *
 * A repeated edge pixel x0 makes the state before the first sample x0 / (1 - p), so edges are exact. */
#ifndef IIR_SECTIONS
#define IIR_SECTIONS 3
#endif

typedef struct {
    float pole_re, pole_im; /* p */
    float gain_re, gain_im; /* c, normalised so that h sums to 1 */
    float rest_re, rest_im; /* 1 / (1 - p): state of a constant input of 1 */
} IirSection;

typedef struct {
    floatn re[IIR_SECTIONS], im[IIR_SECTIONS];
} IirState;

static inline floatn not_negative(floatn v) { return v > 0.0f ? v : (floatn)(0.0f); }

static inline void iir_rest(IirState *s, const __global IirSection *k, floatn x)
{
#pragma unroll
    for (int i = 0; i < IIR_SECTIONS; i++) {
        s->re[i] = k[i].rest_re * x;
        s->im[i] = k[i].rest_im * x;
    }
}

/* s = p*s + x */
static inline void iir_advance(IirState *s, const __global IirSection *k, floatn x)
{
#pragma unroll
    for (int i = 0; i < IIR_SECTIONS; i++) {
        floatn re = k[i].pole_re * s->re[i] + (x - k[i].pole_im * s->im[i]);
        s->im[i] = k[i].pole_re * s->im[i] + k[i].pole_im * s->re[i];
        s->re[i] = re;
    }
}

/* Re(c * s) */
static inline floatn iir_output(const IirState *s, const __global IirSection *k)
{
    floatn y = (floatn)(0.0f);
#pragma unroll
    for (int i = 0; i < IIR_SECTIONS; i++) y += k[i].gain_re * s->re[i] - k[i].gain_im * s->im[i];
    return y;
}

/* Re(c * p * s): the state one step on, before the new sample joins it. */
static inline floatn iir_output_past(const IirState *s, const __global IirSection *k)
{
    floatn y = (floatn)(0.0f);
#pragma unroll
    for (int i = 0; i < IIR_SECTIONS; i++) {
        float a = k[i].gain_re * k[i].pole_re - k[i].gain_im * k[i].pole_im;
        float b = k[i].gain_re * k[i].pole_im + k[i].gain_im * k[i].pole_re;
        y += a * s->re[i] - b * s->im[i];
    }
    return y;
}

/* blur_iir_columns: recursive Gaussian down the columns.
 * reads   image     float[height][pitch][4]
 *         sections  IirSection[IIR_SECTIONS]
 * writes  out       float[height][pitch][4], not image
 * range   1-D, one item per PIXELS pixels of a row, any local size */
__kernel void blur_iir_columns(__global float *restrict out, const __global float *restrict image,
                               const __global IirSection *restrict sections, int width, int height, int pitch)
{
    const int x = PIXELS * (int)get_global_id(0);
    const size_t stride = (size_t)pitch * 4;
    if (x >= width) return;
    const __global float *from = image + x * 4;
    __global float *to = out + x * 4;
    IirState s;
    iir_rest(&s, sections, load_lanes(from));
    for (int y = 0; y < height; y++) {
        iir_advance(&s, sections, load_lanes(from + y * stride));
        store_lanes(to + y * stride, iir_output(&s, sections));
    }
    iir_rest(&s, sections, load_lanes(from + (height - 1) * stride));
    for (int y = height - 1; y >= 0; y--) {
        store_lanes(to + y * stride, not_negative(load_lanes(to + y * stride) + iir_output_past(&s, sections)));
        iir_advance(&s, sections, load_lanes(from + y * stride));
    }
}

/* Pixel x of PIXELS rows. Rows past the last repeat it, so that no lane holds garbage. */
static inline floatn load_rows(const __global float *const row[PIXELS], int x)
{
#define ROW(i) load_pixel(row[i] + x * 4)
    return PIXELS_OF(ROW);
#undef ROW
}

static inline void store_rows(__global float *const row[PIXELS], int x, floatn v)
{
#pragma unroll
    for (int i = 0; i < PIXELS; i++) store_pixel(row[i] + x * 4, pixel_of(v, i));
}

/* blur_iir_rows: recursive Gaussian along the rows, PIXELS rows an item.
 * reads   image     float[height][pitch][4]
 *         sections  IirSection[IIR_SECTIONS]
 * writes  out       float[height][pitch][4], not image
 * range   1-D, one item per PIXELS rows, any local size */
__kernel void blur_iir_rows(__global float *restrict out, const __global float *restrict image,
                            const __global IirSection *restrict sections, int width, int height, int pitch)
{
    const int y = PIXELS * (int)get_global_id(0);
    if (y >= height) return;
    const __global float *from[PIXELS];
    __global float *to[PIXELS];
#pragma unroll
    for (int i = 0; i < PIXELS; i++) {
        size_t offset = (size_t)clamp_index(y + i, height - 1) * pitch * 4;
        from[i] = image + offset;
        to[i] = out + offset;
    }
    IirState s;
    iir_rest(&s, sections, load_rows(from, 0));
    for (int x = 0; x < width; x++) {
        iir_advance(&s, sections, load_rows(from, x));
        store_rows(to, x, iir_output(&s, sections));
    }
    iir_rest(&s, sections, load_rows(from, width - 1));
    for (int x = width - 1; x >= 0; x--) {
        /* Read all before writing any: rows past the last one are the same memory. */
        const floatn forward = load_rows((const __global float *const *)to, x);
        store_rows(to, x, not_negative(forward + iir_output_past(&s, sections)));
        iir_advance(&s, sections, load_rows(from, x));
    }
}
