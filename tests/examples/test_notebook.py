"""The notebook runs from top to bottom as it stands."""

from __future__ import annotations

from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "examples" / "recovery.ipynb"


def read():
    import nbformat

    return nbformat.read(NOTEBOOK, as_version=4)


def test_it_is_kept_without_what_a_run_leaves():
    cells = [cell for cell in read().cells if cell.cell_type == "code"]
    assert cells
    assert all(not cell.outputs and cell.execution_count is None for cell in cells)


@pytest.mark.metaworld
@pytest.mark.lerobot
@pytest.mark.nightly
def test_it_runs_from_top_to_bottom(tmp_path):
    from nbclient import NotebookClient

    ran = NotebookClient(read(), timeout=900, resources={"metadata": {"path": str(tmp_path)}}).execute()
    said = "".join(o.get("text", "") for cell in ran.cells for o in cell.get("outputs", ()))
    assert "initial   " in said
    assert " of 12" in said
    assert any("image/png" in o.get("data", {}) for cell in ran.cells for o in cell.get("outputs", ()))
    assert (tmp_path / "outputs" / "notebook" / "report" / "report.html").is_file()
