"""Scene in, layered frame out. The only OpenGL code of the project; nothing of it is imported before it is used."""
