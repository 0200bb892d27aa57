"""Every notebook runs from its first cell to its last, as a script, without a warning."""

from pathlib import Path

import jax
import jupytext
import matplotlib.pyplot as plt
import pytest

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.py"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook_runs(path, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    notebook = jupytext.read(path)
    cells = [c.source for c in notebook.cells if c.cell_type == "code"]
    assert len(cells) > 5 and any(c.cell_type == "markdown" for c in notebook.cells)
    names = {"__name__": "__main__"}
    before = jax.config.jax_enable_x64
    try:
        for i, source in enumerate(cells):
            exec(compile(source, f"{path.name} cell {i}", "exec"), names)
    finally:
        jax.config.update("jax_enable_x64", before)  # a notebook sets it for good
        plt.close("all")
