"""Float64 numpy twins of the kernels, written from the papers; no pyopencl here."""
