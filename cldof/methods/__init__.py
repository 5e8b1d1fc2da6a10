"""Depth-of-field methods: each declares passes and owns no OpenCL object."""
