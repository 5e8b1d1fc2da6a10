"""OpenCL C sources; read as text by :mod:`cldof.host.program`."""
