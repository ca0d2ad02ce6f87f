"""Compile the twin's physics: cached, with free reordering of operations, but with correct nan, to detect divergence.

Functions that create no array use `no_alloc_kernel`: reference counting would take half of the time of a loop.
"""

import numba as nb

_FASTMATH = {"contract", "reassoc", "arcp", "afn", "nsz"}  # all of fastmath except nnan and ninf

# nogil: identification and prediction run in parallel threads
kernel = nb.njit(cache=True, fastmath=_FASTMATH, error_model="numpy", nogil=True)
no_alloc_kernel = nb.njit(cache=True, fastmath=_FASTMATH, error_model="numpy", nogil=True, _nrt=False)  # type: ignore[call-overload]
inlined_kernel = nb.njit(cache=True, fastmath=_FASTMATH, error_model="numpy", inline="always")
