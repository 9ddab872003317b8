"""Hardware-dependent settings with automatic fallbacks."""

import ctypes
from pathlib import Path

import torch

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD = -1, -2, -3
"""Parameters of glibc's ``mallopt``, from its ``malloc.h``."""
CPU_INFO = Path("/proc/cpuinfo")
"""What Linux says of the processor."""


def keep_freed_memory() -> None:
    """Lets glibc keep the large buffers of a training step instead of returning them to the system.

    Otherwise the kernel clears the same hundreds of megabytes again in every step.
    """
    if mallopt := getattr(ctypes.CDLL(None), "mallopt", None):
        # Older versions of glibc accept at most half of a thread's heap.
        if not mallopt(M_MMAP_THRESHOLD, 1 << 30):
            mallopt(M_MMAP_THRESHOLD, 1 << 25)
        mallopt(M_TRIM_THRESHOLD, 1 << 30)
        mallopt(M_TOP_PAD, 1 << 26)


def resolve_precision(precision: str, accelerator: str) -> str:
    """Lightning's precision for ``auto``: bf16-mixed if the hardware multiplies bf16 faster, else 32-true.

    AMD's AVX-512 and Intel's AMX multiply bf16 faster than fp32. Intel's AVX-512 takes bf16 as well, but is
    slower with it (``make bench-train``, docs/training.md).
    """
    if precision != "auto":
        return precision
    if accelerator != "cpu" and torch.cuda.is_available():
        return "bf16-mixed" if torch.cuda.is_bf16_supported(including_emulation=False) else "32-true"
    flags = torch.cpu.get_capabilities()
    is_amd = CPU_INFO.exists() and "AuthenticAMD" in CPU_INFO.read_text("utf-8")
    return "bf16-mixed" if flags.get("amx_bf16") or (flags.get("avx512_bf16") and is_amd) else "32-true"
