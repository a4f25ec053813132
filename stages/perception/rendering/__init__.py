"""From meshes to images: depth on the CPU and what it costs, colour with OpenGL, a depth camera's noise."""
