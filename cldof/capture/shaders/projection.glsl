// projection.glsl: the pinhole projection from a point on the lens that keeps the plane in focus where it is.
// Row 0 of the window is the top row of the image: focal.y is negative.

uniform vec2 focal;        // x, y of normalised device coordinates per unit of x/w, y/w
uniform vec2 depth_range;  // (near far, near) / (far - near); (near, 0) when far is infinite
uniform vec2 lens_shift;   // focal * lens point / focus distance; focal * lens point when focused at infinity
uniform vec2 focus;        // (focus distance, 1); (1, 0) when focused at infinity
uniform vec2 jitter;       // sub-pixel shift in normalised device coordinates
uniform bool zero_to_one;  // depth clips to [0, 1], not [-1, 1]

// Reversed depth, 1 at near and 0 at far: float32 then resolves inverse depth to its last bits.
vec4 project(vec3 point) {
    float w = -point.z;
    vec4 clip = vec4(focal * point.xy + jitter * w, depth_range.x - depth_range.y * w, w);
    // Exactly 0 for w == focus distance, so what is in focus keeps its bits on every point of the lens.
    clip.xy -= lens_shift * (focus.x - focus.y * w);
    if (!zero_to_one) clip.z = 2.0 * clip.z - w;
    return clip;
}

// Camera-space direction (not unit) of the point at infinity that this lens point sees at ndc.
vec3 direction_at(vec2 ndc) {
    return vec3((ndc - jitter - focus.y * lens_shift) / focal, -1.0);
}
