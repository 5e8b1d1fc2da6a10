// sky.vert: one triangle over the whole window, at depth 0 = far.

uniform bool zero_to_one;

out vec2 ndc;

void main() {
    ndc = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    gl_Position = vec4(ndc, zero_to_one ? 0.0 : -1.0, 1.0);
}
