"""Where a build keeps what it makes."""

from __future__ import annotations

from pathlib import Path

from lerobot_roborecover.curation.pipeline.config import ChainConfig


class BuildPaths:
    """Where a build keeps what it makes.

    Args:
        config: its options.
    """

    def __init__(self, config: ChainConfig):
        self.root = Path(config.out)
        self.candidates = self.root / "candidates"
        self.scenarios = self.root / "scenarios"
        self.screened = self.root / "screened"
        self.validated = self.root / "validated"
        self.split = self.root / "split"
        self.rendered = self.root / "rendered"
        self.result = self.split if config.render is None else self.rendered
        """What a build ends with: episodes, or the divided scenarios."""
        self.summary = self.root / "summary"
        self.old = self.root / "old"
        self.votes = Path(config.annotate.votes) if config.annotate.votes else self.root / "votes"
        self.discuss = self.root / "discuss.json"

    def collected(self, name: str) -> Path:
        """Folder of the rollouts from one source."""
        return self.root / "collect" / name
