"""Run the notebooks without Jupyter, and keep in them what they print and draw: python notebooks/run.py [NAME ...]."""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent


def execute(path: Path) -> tuple[dict[str, Any], list[list[dict[str, Any]]]]:
    """The names that a notebook's cells leave behind, and the outputs of each code cell, as Jupyter would keep them.

    The cells share one namespace; the working directory is the notebook's folder while they run.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    outputs = []
    with contextlib.chdir(path.parent):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                outputs.append(_cell("".join(cell["source"]), f"{path.name}, cell {len(outputs) + 1}", names))
    return names, outputs


def _cell(source: str, where: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """What a cell prints, the value of its last expression, and the figures that it leaves open."""
    import matplotlib.pyplot as plt
    from matplotlib.figure import Figure

    code = ast.parse(source, where)
    last = code.body.pop() if code.body and isinstance(code.body[-1], ast.Expr) else None
    value = None
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(code, where, "exec"), names)
        if last is not None:
            assert isinstance(last, ast.Expr)
            value = eval(compile(ast.Expression(last.value), where, "eval"), names)
    found: list[dict[str, Any]] = []
    if printed.getvalue():
        found.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(keepends=True)})
    figures = [plt.figure(number) for number in plt.get_fignums()]
    if isinstance(value, Figure):
        figures = [value]
    elif value is not None and not source.rstrip().endswith(";"):
        text = repr(value).splitlines(keepends=True)
        found.append({"output_type": "execute_result", "execution_count": None, "metadata": {}, "data": {"text/plain": text}})
    for figure in figures:
        picture = io.BytesIO()
        figure.savefig(picture, format="png", dpi=100)
        data = {"image/png": base64.b64encode(picture.getvalue()).decode("ascii")}
        found.append({"output_type": "display_data", "metadata": {}, "data": data})
    plt.close("all")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the named notebooks, or all, and write their outputs."""
    os.environ.setdefault("MPLBACKEND", "agg")
    named = list(sys.argv[1:] if arguments is None else arguments)
    for path in [FOLDER / name for name in named] or sorted(FOLDER.glob("*.ipynb")):
        _, outputs = execute(path)
        notebook = json.loads(path.read_text(encoding="utf-8"))
        cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        for cell, found in zip(cells, outputs, strict=True):
            cell["outputs"] = found
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(f"{path.name}: {len(cells)} cells")
    return 0


if __name__ == "__main__":
    sys.exit(main())
