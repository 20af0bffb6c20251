"""Who sees which candidate when: an order of their own for every annotator, the same at every start."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable


def queue_order(candidates: Iterable[str], annotator: str, seed: int) -> list[str]:
    """Candidates in an annotator's order.

    A candidate's place depends on its own id alone, so that candidates which come or go later leave the order
    of the others as it was.

    Args:
        candidates: ids.
        annotator: whose order.
        seed: of the study.
    """
    return sorted(candidates, key=lambda c: hashlib.sha256(f"{seed}/{annotator}/{c}".encode()).digest())
