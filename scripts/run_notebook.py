"""Runs the notebook and keeps what it shows.

    python -m scripts.run_notebook examples/recovery.ipynb

Progress and warnings (standard error) are left out, and so is where it ran.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient


def main(notebook: Path) -> None:
    """Executes all cells in an empty folder, and writes the notebook with their outputs."""
    found = nbformat.read(notebook, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(found, timeout=1800, resources={"metadata": {"path": folder}}).execute()
    for cell in found.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.outputs = [o for o in cell.outputs if o.get("name") != "stderr"]
    found.metadata = {"kernelspec": found.metadata["kernelspec"], "language_info": {"name": "python"}}
    nbformat.write(found, notebook)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
