"""Many different worlds at once on an NVIDIA GPU, by Warp: rays and voxels. The truth is
`scenegen.truth.gpu`.

Kernels compute in float64, in the order of those for the processor, without fused multiplications:
their answers have the same bits. Warp's own mode without a GPU (``device="cpu"``) is one slow
thread, and is there for tests.
"""
