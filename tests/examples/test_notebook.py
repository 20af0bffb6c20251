"""The notebook runs from top to bottom as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "recovery.ipynb"


def read():
    import nbformat

    return nbformat.read(NOTEBOOK, as_version=4)


def outputs(notebook) -> list[dict]:
    return [output for cell in notebook.cells for output in cell.get("outputs", ())]


def test_it_ships_with_small_outputs_and_no_paths():
    kept = outputs(read())
    said = "".join(o.get("text", "") for o in kept)
    assert " of 12" in said
    assert any("image/png" in o.get("data", {}) for o in kept)
    assert not [o for o in kept if o.output_type == "error" or o.get("name") == "stderr"]
    assert NOTEBOOK.stat().st_size < 300_000
    assert not re.search(r"(?<![\w.])/(tmp|home|root|work)/", said)


@pytest.mark.metaworld
@pytest.mark.lerobot
@pytest.mark.nightly
def test_it_runs_from_top_to_bottom(tmp_path):
    from nbclient import NotebookClient

    shipped = "".join(o.get("text", "") for o in outputs(read()))
    ran = NotebookClient(read(), timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    said = "".join(o.get("text", "") for o in outputs(ran))
    assert re.findall(r"\w+ +\d+ of 12", said) == re.findall(r"\w+ +\d+ of 12", shipped)
    assert any("image/png" in o.get("data", {}) for o in outputs(ran))
    assert (tmp_path / "outputs" / "notebook" / "report" / "report.html").is_file()
