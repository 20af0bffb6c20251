"""The paper's numbers, as package data: shown beside a user's own, marked as published, never re-run."""

from __future__ import annotations

import csv
import importlib.resources
from dataclasses import dataclass
from functools import cache

from lerobot_roborecover.analysis.stats.intervals import Estimate

TABLES = (
    "contrasts",
    "corpus",
    "interventions",
    "libero_groups",
    "libero_plus",
    "monitor_data",
    "monitor_validation",
    "overall",
    "source_matrix",
    "source_policy_counts",
    "stage_type_counts",
    "stage_type_rates",
)
PLATFORMS = ("robotwin", "libero")


@dataclass(frozen=True)
class PublishedPolicy:
    """One of the paper's twelve rows; rates in [0, 1]."""

    platform: str
    policy: str
    initial: Estimate
    rsr: Estimate
    macro9: float
    libero_plus: float | None
    """Total on LIBERO-Plus, from other authors' publications."""
    libero_plus_note: str


@cache
def table(name: str) -> tuple[dict[str, str], ...]:
    """Rows of one of `TABLES` as published: text, rates in per cent.

    Raises:
        ValueError: there is no such table.
    """
    if name not in TABLES:
        raise ValueError(f"no published table {name!r}; there are {', '.join(TABLES)}")
    folder = importlib.resources.files("lerobot_roborecover").joinpath("data", "published")
    text = folder.joinpath(f"{name}.csv").read_text("utf-8")
    return tuple(csv.DictReader(text.splitlines()))


def policies(platform: str | None = None) -> list[PublishedPolicy]:
    """The paper's rows, of one platform or of both."""
    plus = {}
    for row in table("libero_plus"):
        of = "robotwin" if "platform is RoboTwin" in row["note"] else "libero"
        plus[of, row["policy"]] = row
    found = []
    for row in table("overall"):
        if platform is not None and row["platform"] != platform:
            continue
        other = plus.get((row["platform"], row["policy"]), {})
        total = other.get("libero_plus_total", "")
        found.append(
            PublishedPolicy(
                row["platform"],
                row["policy"],
                _estimate(row, "initial"),
                _estimate(row, "rsr"),
                float(row["macro9"]) / 100,
                float(total) / 100 if total else None,
                other.get("note", ""),
            )
        )
    return found


def _estimate(row: dict[str, str], name: str) -> Estimate:
    return Estimate(*(float(row[f"{name}{suffix}"]) / 100 for suffix in ("", "_lo", "_hi")))
