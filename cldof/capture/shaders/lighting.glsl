// lighting.glsl: hemisphere ambient, directional, point and spot lights on glTF's metallic-roughness surface.
// A light of colour 1 shining straight at white gives 1: pi is folded into the lights.

uniform vec3 eye;             // lens centre, world
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

// Share of a uniform environment that a GGX lobe reflects: Karis, "Physically Based Shading on Mobile" (2014).
vec3 environment_share(vec3 f0, float rough, float n_v) {
    vec4 r = rough * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    float a = min(r.x * r.x, exp2(-9.28 * n_v)) * r.x + r.y;
    vec2 scale_bias = vec2(-1.04, 1.04) * a + r.zw;
    return f0 * scale_bias.x + scale_bias.y;
}

vec3 shade(vec3 position, vec3 n, vec3 base, float metal, float rough) {
    rough = clamp(rough, 0.08, 1.0);
    vec3 v = unit(eye - position);
    float n_v = max(dot(n, v), 1e-3);
    vec3 f0 = mix(vec3(0.04), base, metal);
    vec3 diffuse = base * (1.0 - metal);
    vec3 total = diffuse * ambient_from(n) + environment_share(f0, rough, n_v) * ambient_from(reflect(-v, n));

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
        vec3 fresnel = f0 + (1.0 - f0) * pow(1.0 - clamp(dot(v, h), 0.0, 1.0), 5.0);
        vec3 specular = fresnel * (alpha2 / (4.0 * d * d * masking));  // times pi, as the lights are
        total += (diffuse * (1.0 - fresnel) + specular) * light * n_l;
    }
    return total;
}
