"""One rounding for every processor.

OpenBLAS chooses its kernels by what the processor can do, and they round the last bit differently: with
AVX-512 kernels instead of AVX2 ones no LIBERO state was the same, and contacts made up to 4.6 mm of it
(docs/log/exactness.md). So simulators compute with the AVX2 kernels everywhere. NumPy's own dispatch, numba's
and the C library's made no difference.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

VARIABLE = "OPENBLAS_CORETYPE"
CORE_TYPE = "Haswell"
"""AVX2 and FMA: every x86-64 processor since 2015 has them."""

KERNELS: Mapping[str, str] = {
    "OMP_NUM_THREADS": "1",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "COMPATIBLE",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
}
"""torch's kernels, its own, MKL's and oneDNN's, chosen alike on every x86-64 processor with AVX2, so that
policies round alike. They are read when torch is loaded: given to a process, not set in one."""


def policy_kernels() -> dict[str, str]:
    """`KERNELS`, or no more than one thread on a processor that lacks them."""
    return dict(KERNELS) if has_kernels() else {"OMP_NUM_THREADS": KERNELS["OMP_NUM_THREADS"]}


def pin_policy_kernels() -> bool:
    """Chooses `policy_kernels` for this process and its children, except what the user has chosen.

    Returns:
        Whether the choice takes effect: torch reads the variables when it is loaded, so that nothing is
        chosen where it has been.
    """
    if "torch" in sys.modules:
        return False
    for name, value in policy_kernels().items():
        os.environ.setdefault(name, value)
    return True


def pin_blas_kernels() -> None:
    """Chooses the kernels for this process and its children, unless the user has.

    OpenBLAS reads the choice when it is loaded: call this before numpy is imported. On a processor that
    lacks the kernels nothing is chosen, since they would crash it.
    """
    if VARIABLE not in os.environ and has_kernels():
        os.environ[VARIABLE] = CORE_TYPE


def has_kernels(cpuinfo: Path = Path("/proc/cpuinfo")) -> bool:
    """Whether this processor has AVX2 and FMA, as far as Linux tells."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    try:
        with open(
            cpuinfo, encoding="utf-8", errors="replace"
        ) as file:  # a paragraph for each core: the first
            flags = next((line for line in file if line.startswith("flags")), "")
    except OSError:
        return False
    return {"avx2", "fma"} <= set(flags.split())


def core_type_in_use() -> str:
    """Kernels of the OpenBLAS that numpy has loaded, as OpenBLAS names them; empty where it cannot tell."""
    import ctypes

    import numpy as np

    libraries = Path(np.__file__).parent.with_name("numpy.libs")
    for path in sorted(libraries.glob("*openblas*")):
        for name in ("scipy_openblas_get_corename64_", "openblas_get_corename64_", "openblas_get_corename"):
            function = getattr(ctypes.CDLL(str(path)), name, None)
            if function is not None:
                function.restype = ctypes.c_char_p
                return function().decode()
    return ""
