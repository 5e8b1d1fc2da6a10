/* shading.cl: surface buffers made ready for shading.clh, once a frame and for any lens. */

#include "common.clh"
#include "shading.clh"

/* One value of 16 pixels, every stride floats; past the end of a row 0. */
static inline float16 shading_every(const __global float *p, int stride, int count)
{
    float v[16];
    for (int i = 0; i < 16; i++) v[i] = i < count ? p[i * stride] : 0.0f;
    return *(float16_unaligned *)v;
}

/* shading_split: colour without what surfaces mirror towards the lens centre, and the surfaces as planes.
 * Slots that mirror nothing keep their colour to the bit.
 * reads   color      float[peels][height][width][4]  premultiplied
 *         inv_depth  float[peels][height][pitch]     1/m
 *         normal, specular  float[peels][height][width][3]
 *         shininess  float[peels][height][width]     Phong exponent
 *         lighting, environment  see shading.clh
 * writes  matte      float[peels][height][width][4]  premultiplied
 *         surface    float[peels][SHADING_PLANES][height][pitch]  unit normal, specular, roughness
 * range   3-D, one item per 16 pixels of a row of a peel, any local size */
#define SHADING_PLANES 7
__kernel void shading_split(__global float *restrict matte, __global float *restrict surface,
                            const __global float *restrict color, const __global float *restrict inv_depth,
                            const __global float *restrict normal, const __global float *restrict specular,
                            const __global float *restrict shininess, const __global float4 *restrict lighting,
                            const __global float4 *restrict environment, int peels, int height, int width, int pitch)
{
    const int x = 16 * (int)get_global_id(0), y = get_global_id(1), m = get_global_id(2);
    if (x >= pitch || y >= height || m >= peels) return;
    const size_t row = (size_t)m * height + y, at = row * width + x;
    const int count = width - x < 16 ? width - x : 16;
    Shading3 n = shading_3(shading_every(normal + 3 * at, 3, count), shading_every(normal + 3 * at + 1, 3, count),
                           shading_every(normal + 3 * at + 2, 3, count));
    const shading_t square = shading_dot(n, n);
    const shading_t scale = square > 1e-12f ? shading_rsqrt(square) : (shading_t)(0.0f);
    n = shading_3(n.x * scale, n.y * scale, n.z * scale);
    const Shading3 f0 = shading_3(shading_every(specular + 3 * at, 3, count),
                                  shading_every(specular + 3 * at + 1, 3, count),
                                  shading_every(specular + 3 * at + 2, 3, count));
    const shading_t rough = shading_roughness(shading_every(shininess + at, 1, count));
    const float16 planes[SHADING_PLANES] = {n.x, n.y, n.z, f0.x, f0.y, f0.z, rough};
    __global float *out = surface + (((size_t)m * SHADING_PLANES * height) + y) * pitch + x;
    for (int p = 0; p < SHADING_PLANES; p++) store_quad(out + (size_t)p * height * pitch, planes[p]);

    Shading3 light = shading_3((shading_t)(0.0f), (shading_t)(0.0f), (shading_t)(0.0f));
    if (sum16(f0.x + f0.y + f0.z) > 0.0f) {
        const float16 lanes = (float16)(0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f, 8.5f, 9.5f, 10.5f, 11.5f, 12.5f,
                                        13.5f, 14.5f, 15.5f);
        const float16 w = load_quad(inv_depth + row * pitch + x);
        const Shading3 position = shading_position(lighting, (float)x + lanes, (float16)((float)y + 0.5f), w);
        light = shading_specular(position, n, f0, rough, lighting[7], lighting, environment);
    }
    float r[16], g[16], b[16];
    *(float16_unaligned *)r = light.x;
    *(float16_unaligned *)g = light.y;
    *(float16_unaligned *)b = light.z;
    for (int i = 0; i < count; i++) {
        const float4 c = load_pixel(color + (at + i) * 4);
        float4 rest = c - c.w * (float4)(r[i], g[i], b[i], 0.0f);
        rest = rest > 0.0f ? rest : (float4)(0.0f);
        rest.w = c.w;
        store_pixel(matte + (at + i) * 4, rest);
    }
}
