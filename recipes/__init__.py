"""How the shipped sets, policies and studies were made: run from a clone, not installed."""

from lerobot_roborecover.utils.determinism import pin_blas_kernels

pin_blas_kernels()  # before anything here imports numpy
