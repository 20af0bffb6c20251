"""The tutorials, from top to bottom: every block of a page, in order, in one shell, as a reader would."""

from __future__ import annotations

import os
import subprocess

import pytest

from tests.platforms.test_outside_platform import environment  # noqa: F401 - a fixture
from tests.support.doc_blocks import ROOT, blocks_of

TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
LEFT = {
    "evaluate": ["act-recovery/trials.jsonl", "act_clean-initial/eval_info.json", "report/report.html"],
    "scenarios": ["validated/meta/roborecover/scenarios.parquet", "on_my_scenarios/trials.jsonl"],
    "interventions": ["correction/model.safetensors", "monitor_report", "monitor_correction/trials.jsonl"],
    "platform": ["crane_scenarios/meta/roborecover/manifest.json", "crane_report/report.html"],
}
"""Files of each tutorial, below `outputs/tutorial`."""


def script(page) -> str:
    parts = []
    for block in blocks_of(page):
        if block.why_not_run or block.language not in ("bash", "python"):
            continue
        is_shell = block.language == "bash"
        parts.append(block.code if is_shell else f"python - <<'END'\n{block.code}END\n")
    return "\n".join(parts)


@pytest.mark.lerobot
@pytest.mark.metaworld
@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("page", TUTORIALS, ids=[p.stem for p in TUTORIALS])
def test_a_tutorial_runs(page, environment, tmp_path):  # noqa: F811
    for name in ("lerobot_roborecover", "policies", "examples"):
        (tmp_path / name).symlink_to(ROOT / name)
    paths = os.pathsep.join([str(ROOT), environment["PYTHONPATH"]])
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script(page)],
        cwd=tmp_path,
        env={**environment, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-3000:]
    for name in LEFT[page.stem]:
        assert (tmp_path / "outputs" / "tutorial" / name).exists(), name
