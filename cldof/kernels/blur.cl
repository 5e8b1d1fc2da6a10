/* blur.cl: Gaussian blur of an RGBA image by two engines, FIR and recursive (IIR).
 *
 * Images are float[height][pitch][4], pitch a multiple of 16 pixels and at least width; pixels from width to pitch are
 * scratch. Beyond its edges the image repeats its edge pixels, so a constant image stays constant. */

#include "common.clh"
#include "fir.clh"

/* blur_fir: both directions of a separable FIR filter in one pass.
 * source  direct convolution; the taps come from cldof.methods.gaussian.fir_taps
 * reads   image  float[height][pitch][4]
 *         taps   float[2*radius + 1 + 2*FIR_PAD]  centre at FIR_PAD + radius
 * writes  out    float[height][pitch][4], not image
 * range   2-D groups: (segments of a row, blocks of FIR_ROWS rows); local size (any, 1)
 * local   lines  float[FIR_ROWS][segment + 2*halo][4], halo = radius + 4 rounded up to a multiple of 4 */
__kernel void blur_fir(__global float *restrict out, const __global float *restrict image,
                       const __global float *restrict taps, int width, int height, int pitch, int radius, int segment,
                       __local float *restrict lines)
{
    const int halo = (radius + 7) & ~3;
    const int line_width = segment + 2 * halo;
    const int x0 = (int)get_group_id(0) * segment;
    const int y0 = (int)get_group_id(1) * FIR_ROWS;
    const __global float *centre = taps + FIR_PAD + radius;

    for (int b = get_local_id(0); b < line_width / 4; b += get_local_size(0)) {
        int x = x0 - halo + 4 * b;
        if (x < 0 || x >= width) continue;
        float16 acc[FIR_ROWS];
        fir_columns(acc, image, x, y0, height, pitch, centre, radius);
#pragma unroll
        for (int i = 0; i < FIR_ROWS; i++) store_quad_local(lines + (i * line_width + 4 * b) * 4, acc[i]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    fir_extend_lines(lines, line_width, x0 - halo, width);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int b = get_local_id(0); b < segment / 8; b += get_local_size(0)) {
        int x = x0 + 8 * b;
        if (x < pitch)
            fir_store_pair(out, lines, line_width, 8 * b + halo, x, y0, height, pitch, centre, radius);
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
    float16 re[IIR_SECTIONS], im[IIR_SECTIONS];
} IirState;

static inline float16 not_negative(float16 v) { return v > 0.0f ? v : (float16)(0.0f); }

static inline void iir_rest(IirState *s, const __global IirSection *k, float16 x)
{
#pragma unroll
    for (int i = 0; i < IIR_SECTIONS; i++) {
        s->re[i] = k[i].rest_re * x;
        s->im[i] = k[i].rest_im * x;
    }
}

/* s = p*s + x */
static inline void iir_advance(IirState *s, const __global IirSection *k, float16 x)
{
#pragma unroll
    for (int i = 0; i < IIR_SECTIONS; i++) {
        float16 re = k[i].pole_re * s->re[i] + (x - k[i].pole_im * s->im[i]);
        s->im[i] = k[i].pole_re * s->im[i] + k[i].pole_im * s->re[i];
        s->re[i] = re;
    }
}

/* Re(c * s) */
static inline float16 iir_output(const IirState *s, const __global IirSection *k)
{
    float16 y = (float16)(0.0f);
#pragma unroll
    for (int i = 0; i < IIR_SECTIONS; i++) y += k[i].gain_re * s->re[i] - k[i].gain_im * s->im[i];
    return y;
}

/* Re(c * p * s): the state one step on, before the new sample joins it. */
static inline float16 iir_output_past(const IirState *s, const __global IirSection *k)
{
    float16 y = (float16)(0.0f);
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
 * range   1-D, one item per quad of a row, any local size */
__kernel void blur_iir_columns(__global float *restrict out, const __global float *restrict image,
                               const __global IirSection *restrict sections, int width, int height, int pitch)
{
    const int x = 4 * (int)get_global_id(0);
    const size_t stride = (size_t)pitch * 4;
    if (x >= width) return;
    const __global float *from = image + x * 4;
    __global float *to = out + x * 4;
    IirState s;
    iir_rest(&s, sections, load_quad(from));
    for (int y = 0; y < height; y++) {
        iir_advance(&s, sections, load_quad(from + y * stride));
        store_quad(to + y * stride, iir_output(&s, sections));
    }
    iir_rest(&s, sections, load_quad(from + (height - 1) * stride));
    for (int y = height - 1; y >= 0; y--) {
        store_quad(to + y * stride, not_negative(load_quad(to + y * stride) + iir_output_past(&s, sections)));
        iir_advance(&s, sections, load_quad(from + y * stride));
    }
}

/* Pixel x of four rows. Rows past the last repeat it, so that no lane holds garbage. */
static inline float16 load_rows(const __global float *const row[4], int x)
{
    return (float16)(load_pixel(row[0] + x * 4), load_pixel(row[1] + x * 4), load_pixel(row[2] + x * 4),
                     load_pixel(row[3] + x * 4));
}

/* blur_iir_rows: recursive Gaussian along the rows, four rows an item.
 * reads   image     float[height][pitch][4]
 *         sections  IirSection[IIR_SECTIONS]
 * writes  out       float[height][pitch][4], not image
 * range   1-D, one item per four rows, any local size */
__kernel void blur_iir_rows(__global float *restrict out, const __global float *restrict image,
                            const __global IirSection *restrict sections, int width, int height, int pitch)
{
    const int y = 4 * (int)get_global_id(0);
    if (y >= height) return;
    const __global float *from[4];
    __global float *to[4];
#pragma unroll
    for (int i = 0; i < 4; i++) {
        size_t offset = (size_t)clamp_index(y + i, height - 1) * pitch * 4;
        from[i] = image + offset;
        to[i] = out + offset;
    }
    IirState s;
    iir_rest(&s, sections, load_rows(from, 0));
    for (int x = 0; x < width; x++) {
        iir_advance(&s, sections, load_rows(from, x));
        float16 v = iir_output(&s, sections);
        store_pixel(to[0] + x * 4, v.s0123);
        store_pixel(to[1] + x * 4, v.s4567);
        store_pixel(to[2] + x * 4, v.s89ab);
        store_pixel(to[3] + x * 4, v.scdef);
    }
    iir_rest(&s, sections, load_rows(from, width - 1));
    for (int x = width - 1; x >= 0; x--) {
        /* Read all four before writing any: rows past the last one are the same memory. */
        float16 v = (float16)(load_pixel(to[0] + x * 4), load_pixel(to[1] + x * 4), load_pixel(to[2] + x * 4),
                              load_pixel(to[3] + x * 4));
        v = not_negative(v + iir_output_past(&s, sections));
        store_pixel(to[0] + x * 4, v.s0123);
        store_pixel(to[1] + x * 4, v.s4567);
        store_pixel(to[2] + x * 4, v.s89ab);
        store_pixel(to[3] + x * 4, v.scdef);
        iir_advance(&s, sections, load_rows(from, x));
    }
}
