// sky.frag: fills the first slot that no surface took; a pixel that already ended stays empty.
// Defines: SURFACE, ENVIRONMENT.

#include "peel.glsl"
#include "projection.glsl"
#ifdef ENVIRONMENT
#include "environment.glsl"
uniform mat3 to_world;  // camera axes to world
#endif

in vec2 ndc;

uniform vec3 up;  // world up in camera space
uniform vec3 sky_top;
uniform vec3 sky_bottom;

void main() {
    if (!first_layer && previous_inverse_depth() == 0.0) discard;
    vec3 direction = direction_at(ndc);
#ifdef ENVIRONMENT
    out_color = vec4(environment_level(to_world * direction, 0), 1.0);
#else
    out_color = vec4(mix(sky_bottom, sky_top, 0.5 + 0.5 * dot(normalize(direction), up)), 1.0);
#endif
    out_inverse_depth = 0.0;
#ifdef SURFACE
    out_normal = vec4(0.0);
    out_albedo = vec4(0.0);
    out_specular = vec4(0.0);
#endif
}
