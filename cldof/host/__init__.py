"""The OpenCL host side: devices, programs, buffers, launches, scheduling. Knows nothing of lenses."""
