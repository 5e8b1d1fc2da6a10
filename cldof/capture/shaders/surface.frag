// surface.frag: one fragment of one peel: peel test, back faces, alpha, light.
// Defines: BASE_TEXTURE, EMISSIVE_TEXTURE, ROUGHNESS_TEXTURE, LIT, MASK, BLEND, DOUBLE_SIDED, SURFACE, ENVIRONMENT.

#include "peel.glsl"
#include "lighting.glsl"

in vec3 world_position;
in vec3 camera_position;
in vec3 world_normal;
in vec2 surface_uv;
in vec4 vertex_color;

uniform vec2 lens_point;       // metres, camera x and y; (0, 0) for layers
uniform float lens_reach;      // metres; < 0: back faces stay
uniform bool stop_at_opaque;   // an opaque fragment ends its pixel: what is behind is never asked for
uniform vec4 base_color;
uniform vec3 emissive;
uniform float metallic;
uniform float roughness;
uniform float alpha_cutoff;
uniform float lod_bias;        // mip levels that textures are coarser by
#ifdef BASE_TEXTURE
uniform sampler2D base_texture;
#endif
#ifdef EMISSIVE_TEXTURE
uniform sampler2D emissive_texture;
#endif
#ifdef ROUGHNESS_TEXTURE
uniform sampler2D metallic_roughness_texture;
#endif

// Camera-space normal of the triangle, pointing out of its front.
vec3 front_normal() {
    vec3 normal = cross(dFdx(camera_position), dFdy(camera_position));
    bool towards = dot(normal, vec3(lens_point, 0.0) - camera_position) > 0.0;
    return towards == gl_FrontFacing ? normal : -normal;
}

void main() {
    vec4 base = base_color * vertex_color;
    vec3 emission = emissive;
#ifdef BASE_TEXTURE
    base *= texture(base_texture, surface_uv, lod_bias);
#endif
#ifdef EMISSIVE_TEXTURE
    emission *= texture(emissive_texture, surface_uv, lod_bias).rgb;
#endif
    float metal = metallic;
    float rough = roughness;
#ifdef ROUGHNESS_TEXTURE
    vec4 texel = texture(metallic_roughness_texture, surface_uv, lod_bias);
    metal *= texel.b;
    rough *= texel.g;
#endif
    vec3 front = front_normal();

    float inverse_depth = gl_FragCoord.w;
    if (is_peeled(inverse_depth)) discard;
#ifndef DOUBLE_SIDED
    // Lens point L sees the front when dot(front, L - position) > 0; the best of all |L| <= reach decides.
    if (lens_reach >= 0.0 && !gl_FrontFacing && lens_reach * length(front.xy) <= dot(front, camera_position)) discard;
#endif
    float alpha = 1.0;
#ifdef MASK
    if (base.a < alpha_cutoff) discard;
#endif
#ifdef BLEND
    alpha = min(base.a, 1.0);
    if (alpha <= 0.0) discard;
#endif

    vec3 normal = unit(world_normal);
    bool turn = lens_reach < 0.0;
#ifdef DOUBLE_SIDED
    turn = true;
#endif
    if (turn && dot(front, camera_position) > 0.0) normal = -normal;
#ifdef LIT
    vec3 color = emission + shade(world_position, normal, base.rgb, metal, rough);
#else
    vec3 color = emission + base.rgb;
#endif
    out_color = vec4(color * alpha, alpha);
    out_inverse_depth = stop_at_opaque && alpha >= 1.0 ? 0.0 : inverse_depth;
#ifdef SURFACE
    // Phong exponent of the GGX lobe's width: alpha = roughness^2, n = 2 / alpha^2 - 2.
    float width = usable_roughness(rough);
    width *= width;
    out_normal = vec4(normal, 2.0 / (width * width) - 2.0);
#ifdef LIT
    out_albedo = vec4(base.rgb * (1.0 - metal), 1.0);
    out_specular = vec4(min(specular_of(base.rgb, metal), vec3(1.0)), 1.0);
#else
    out_albedo = vec4(base.rgb, 1.0);
    out_specular = vec4(0.0);
#endif
#endif
}
