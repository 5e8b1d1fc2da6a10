// sky.frag: fills the first slot that no surface took; a pixel that already ended stays empty.
// Defines: SURFACE.

#include "peel.glsl"
#include "projection.glsl"

in vec2 ndc;

uniform vec3 up;  // world up in camera space
uniform vec3 sky_top;
uniform vec3 sky_bottom;

void main() {
    if (!first_layer && previous_inverse_depth() == 0.0) discard;
    float height = dot(normalize(direction_at(ndc)), up);
    out_color = vec4(mix(sky_bottom, sky_top, 0.5 + 0.5 * height), 1.0);
    out_inverse_depth = 0.0;
#ifdef SURFACE
    out_normal = vec4(0.0);
    out_albedo = vec4(0.0);
#endif
}
