// lighting.glsl: hemisphere ambient, directional, point and spot lights on glTF's metallic-roughness surface.
// A light of colour 1 shining straight at white gives 1: pi is folded into the lights.
// kernels/shading.clh has the part that depends on the eye; tests/oracles/shading.py has all of it in float64.
// Defines: ENVIRONMENT (takes the place of the hemisphere).

#ifdef ENVIRONMENT
#include "environment.glsl"
#endif

uniform vec3 eye;             // world; the lens centre, or a point on the lens
uniform vec3 ambient_sky;
uniform vec3 ambient_ground;
uniform int directional_count;
uniform vec3 directional_to_light[8];  // unit
uniform vec3 directional_color[8];
uniform int point_count;
uniform vec3 point_position[8];
uniform vec3 point_color[8];
uniform vec4 point_cone[8];   // axis (unit, or 0), cosine of the outer half angle
uniform float point_cone_inner[8];  // cosine of the inner half angle

vec3 unit(vec3 v) {
    float square = dot(v, v);
    return square > 0.0 ? v * inversesqrt(square) : vec3(0.0, 0.0, 1.0);
}

vec3 ambient_from(vec3 direction) { return mix(ambient_ground, ambient_sky, 0.5 + 0.5 * direction.y); }

#ifdef ENVIRONMENT
vec3 irradiance_on(vec3 n) { return environment_level(n, IRRADIANCE); }
vec3 mirrored_from(vec3 direction, float rough) { return environment_from(direction, rough); }
#else
vec3 irradiance_on(vec3 n) { return ambient_from(n); }
vec3 mirrored_from(vec3 direction, float rough) { return ambient_from(direction); }
#endif

// Reflectance at grazing angles: all, but for what reflects next to nothing straight on (Lagarde 2011).
float grazing(vec3 f0) { return clamp(50.0 * max(f0.r, max(f0.g, f0.b)), 0.0, 1.0); }

// Share of a uniform environment that a GGX lobe reflects: Karis, "Physically Based Shading on Mobile" (2014).
vec3 environment_share(vec3 f0, float rough, float n_v) {
    vec4 r = rough * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    float a = min(r.x * r.x, exp2(-9.28 * n_v)) * r.x + r.y;
    vec2 scale_bias = vec2(-1.04, 1.04) * a + r.zw;
    return f0 * scale_bias.x + grazing(f0) * scale_bias.y;
}

vec3 specular_of(vec3 base, float metal) { return mix(vec3(0.04), base, metal); }
float usable_roughness(float rough) { return clamp(rough, 0.08, 1.0); }

vec3 shade(vec3 position, vec3 n, vec3 base, float metal, float rough) {
    rough = usable_roughness(rough);
    vec3 v = unit(eye - position);
    float n_v = max(dot(n, v), 1e-3);
    vec3 f0 = specular_of(base, metal);
    vec3 diffuse = base * (1.0 - metal);
    vec3 total = diffuse * irradiance_on(n) + environment_share(f0, rough, n_v) * mirrored_from(reflect(-v, n), rough);

    float alpha2 = rough * rough * rough * rough;
    float k = rough * rough * 0.5;  // Schlick's fit of Smith's masking
    for (int i = 0; i < directional_count + point_count; ++i) {
        vec3 l;
        vec3 light;
        if (i < directional_count) {
            l = directional_to_light[i];
            light = directional_color[i];
        } else {
            int p = i - directional_count;
            vec3 to_light = point_position[p] - position;
            l = unit(to_light);
            light = point_color[p] / max(dot(to_light, to_light), 1e-6);
            vec4 cone = point_cone[p];
            if (dot(cone.xyz, cone.xyz) > 0.0) {
                light *= smoothstep(cone.w, max(point_cone_inner[p], cone.w + 1e-4), dot(-l, cone.xyz));
            }
        }
        float n_l = dot(n, l);
        if (n_l <= 0.0) continue;
        vec3 h = unit(l + v);
        float n_h = max(dot(n, h), 0.0);
        float d = n_h * n_h * (alpha2 - 1.0) + 1.0;
        float masking = (n_l * (1.0 - k) + k) * (n_v * (1.0 - k) + k);
        vec3 fresnel = f0 + (grazing(f0) - f0) * pow(1.0 - clamp(dot(v, h), 0.0, 1.0), 5.0);
        vec3 specular = fresnel * (alpha2 / (4.0 * d * d * masking));  // times pi, as the lights are
        total += (diffuse * (1.0 - fresnel) + specular) * light * n_l;
    }
    return total;
}
