"""Scene in, layered frame out. The only OpenGL code of the project."""
