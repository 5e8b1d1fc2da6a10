// surface.vert: places a vertex for one point on the lens.
// Defines: UV_LOCATION, COLOR_LOCATION (when the mesh has them).

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
#ifdef UV_LOCATION
layout(location = UV_LOCATION) in vec2 uv;
#endif
#ifdef COLOR_LOCATION
layout(location = COLOR_LOCATION) in vec4 color;
#endif

uniform mat4 model;          // mesh to world
uniform mat4 model_view;     // mesh to camera, multiplied in float64
uniform mat3 normal_matrix;  // mesh normals to world
#include "projection.glsl"

// Passes and peels must agree to the last bit, whichever program draws.
invariant gl_Position;

out vec3 world_position;
out vec3 camera_position;
out vec3 world_normal;
out vec2 surface_uv;
out vec4 vertex_color;

void main() {
    vec4 in_mesh = vec4(position, 1.0);
    camera_position = (model_view * in_mesh).xyz;
    world_position = (model * in_mesh).xyz;
    world_normal = normal_matrix * normal;
    surface_uv = vec2(0.0);
#ifdef UV_LOCATION
    surface_uv = uv;
#endif
    vertex_color = vec4(1.0);
#ifdef COLOR_LOCATION
    vertex_color = color;
#endif
    gl_Position = project(camera_position);
}
