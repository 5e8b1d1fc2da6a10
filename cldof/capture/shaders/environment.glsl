// environment.glsl: light from all around, prefiltered by roughness (cldof.lighting.Environment has the layout).

uniform sampler2D environment;  // all levels one after the other, in rows of 512 texels
const int SIDES[7] = int[7](256, 128, 64, 32, 16, 16, 16);
const int STARTS[7] = int[7](0, 66564, 83464, 87820, 88976, 89300, 89624);
const int IRRADIANCE = 6;

vec3 environment_texel(int index) { return texelFetch(environment, ivec2(index & 511, index >> 9), 0).rgb; }

// Between texels of an octahedral map with a border, seen in a direction of any length.
vec3 environment_level(vec3 direction, int level) {
    vec3 d = direction / (abs(direction.x) + abs(direction.y) + abs(direction.z));
    float fold = max(-d.y, 0.0);
    vec2 map = d.xz + vec2(d.x < 0.0 ? -fold : fold, d.z < 0.0 ? -fold : fold);
    int side = SIDES[level];
    vec2 at = (map + 1.0) * (0.5 * float(side)) + 0.5;
    ivec2 first = clamp(ivec2(floor(at)), ivec2(0), ivec2(side));
    vec2 share = at - vec2(first);
    int index = STARTS[level] + first.y * (side + 2) + first.x;
    vec3 above = mix(environment_texel(index), environment_texel(index + 1), share.x);
    vec3 below = mix(environment_texel(index + side + 2), environment_texel(index + side + 3), share.x);
    return mix(above, below, share.y);
}

vec3 environment_from(vec3 direction, float rough) {
    float level = rough * 5.0;
    int sharper = clamp(int(level), 0, 4);
    return mix(environment_level(direction, sharper), environment_level(direction, sharper + 1), level - float(sharper));
}
