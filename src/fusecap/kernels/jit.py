"""How kernels are compiled: ahead of use, cached on disk, without the GIL.

numba keys its cache on the file of the compiled function alone, so an edited helper in another file
would leave stale machine code behind. A stamp over all kernel sources guards against that: when it
changes, the cache beside the sources is dropped.

`fastmath` allows reordering and contraction: NaN and infinity keep their meaning, but x - x may
become 0, and with it isfinite(x). Kernels test with ordered comparisons (`x < FINITE`), which are
false for NaN.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

FINITE = 1e300
"""Every finite number of ours is below this; NaN and infinity are not."""

LOSS_SCALE = 9.0
"""k of the loss ½ k log(1 + λ‖r‖²/k) of terms whose λ is one over a variance: Cauchy's, which lets
go beyond three standard deviations."""

_log = logging.getLogger("fusecap")
_folder = Path(__file__).parent
_announced = False


def _drop_stale_cache() -> None:
    sources = sorted(_folder.rglob("*.py"))
    state = [(str(p.relative_to(_folder)), p.stat().st_mtime_ns, p.stat().st_size) for p in sources]
    stamp = hashlib.sha256(repr(state).encode()).hexdigest()
    stamp_file = _folder / "__pycache__" / "sources.stamp"
    with contextlib.suppress(OSError):
        if stamp_file.is_file() and stamp_file.read_text() == stamp:
            return
        for cached in [*_folder.rglob("*.nbi"), *_folder.rglob("*.nbc")]:
            cached.unlink(missing_ok=True)
        stamp_file.parent.mkdir(exist_ok=True)
        stamp_file.write_text(stamp)


def _announce(how_often: str) -> None:
    global _announced
    if not _announced:
        _announced = True
        _log.warning("compiling the numerical kernels for this machine: %s", how_often)


def _compiled(signature: Any, function: Callable[..., Any], *, cache: bool) -> Any:
    return numba.njit(
        signature,
        cache=cache,
        nogil=True,
        error_model="numpy",
        fastmath={"contract", "reassoc", "nsz"},
    )(function)


def kernel(signature: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function for one explicit signature; says so once when the cache is cold."""

    def compile_now(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            compiled = _compiled(signature, function, cache=True)
        except RuntimeError as error:
            if "no locator available" not in str(error):
                raise
            _announce("every time, as no folder can keep them: set NUMBA_CACHE_DIR to one that can")
            return _compiled(signature, function, cache=False)
        if getattr(compiled, "stats", None) and compiled.stats.cache_misses:
            _announce("once, about a minute")
        return compiled

    return compile_now


_drop_stale_cache()
