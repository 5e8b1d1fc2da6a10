// peel.glsl: what a fragment shader writes, and which fragments were peeled before.

layout(location = 0) out vec4 out_color;           // linear light, premultiplied
layout(location = 1) out float out_inverse_depth;  // 1/z in 1/m; 0 = infinity: sky, or nothing
#ifdef SURFACE
layout(location = 2) out vec4 out_normal;          // world-space unit normal, Phong exponent
layout(location = 3) out vec4 out_albedo;          // diffuse reflectance, linear
layout(location = 4) out vec4 out_specular;        // specular reflectance straight on, linear; 0 = matte
#endif

uniform sampler2D previous;  // inverse depth of the layer before
uniform bool first_layer;
// Least relative step in inverse depth between two layers: above the rounding of two coplanar surfaces seen at 88
// degrees (1e-6 is not), far below anything that the eye can tell.
const float SEPARATION = 1e-5;

float previous_inverse_depth() { return texelFetch(previous, ivec2(gl_FragCoord.xy), 0).r; }

// Where the layer before holds infinity this is true for every fragment, so empty stays empty.
bool is_peeled(float inverse_depth) {
    return !first_layer && inverse_depth >= previous_inverse_depth() * (1.0 - SEPARATION);
}
