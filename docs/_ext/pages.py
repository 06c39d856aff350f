"""What the site makes of files that are there for other reasons: experiments, notebooks, docstrings; and formulas without a network."""

from __future__ import annotations

import ast
import base64
import json
import re
import shutil
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math import latex2mathml

HIDDEN = ("binary_windows", "gradient_cases", "harness", "readme_numbers", "run_all", "speed_against", "speed_history")
PAPER = "fig"


def write_experiments(root: Path, target: Path) -> None:
    """The scripts of ``experiments/`` for sphinx-gallery: a title, the kept figure, its printed numbers, the code."""
    shutil.rmtree(target, ignore_errors=True)
    groups = {
        "1_paper": "The paper's figures\n-------------------\n\nEach made again from fresh chains, with the paper's digits beside the measured ones.",
        "2_charts": "Charts and checks\n-----------------\n\nAccuracy against cost, against other codes and closed forms, and where methods fail.",
    }
    for group, words in groups.items():
        (target / group).mkdir(parents=True)
        (target / group / "GALLERY_HEADER.rst").write_text(words + "\n", encoding="utf-8")
    (target / "GALLERY_HEADER.rst").write_text(
        "Gallery of experiments\n======================\n\nOne script for each figure of the paper and for each chart; "
        "run any of them with ``python experiments/NAME.py``.\nThe tables of numbers are on :doc:`/experiments`.\n",
        encoding="utf-8",
    )
    for path in sorted((root / "experiments").glob("*.py")):
        if path.stem in HIDDEN:
            continue
        text = path.read_text(encoding="utf-8")
        words = " ".join((ast.get_docstring(ast.parse(text)) or path.stem).split("\n\n")[0].split())
        body = text.split('"""', 2)[2].lstrip("\n")
        head, _, tail = words.partition(": ")
        title, more = (f"{head}: {tail.split(',')[0].rstrip('.')}" if head.startswith("Fig. ") else path.stem), words
        title = title.replace("^2", "²")
        picture, report = root / "docs" / "gallery" / f"{path.stem}.png", root / "docs" / "gallery" / f"{path.stem}.txt"
        lines = [title, "=" * (len(title) + 2), "", plain(more), "", f"Run it: ``python experiments/{path.stem}.py``"]
        if report.is_file() and (made := report.read_text(encoding="utf-8").splitlines()[0]).startswith("$ "):
            lines += ["", f"Figure and numbers below are those of a smaller run, ``{made[2:]}``; the full run's are in the tables of :doc:`/experiments`."]
        group = target / ("1_paper" if path.stem.startswith(PAPER) else "2_charts")
        thumbnail = ""
        if picture.is_file():
            lines += ["", f".. image:: /gallery/{path.stem}.png", f"   :alt: {plain(title)}"]
            thumbnail = f"# sphinx_gallery_thumbnail_path = 'gallery/{path.stem}.png'\n"
        if report.is_file():
            lines += ["", "What it prints:", "", f".. literalinclude:: /gallery/{path.stem}.txt", "   :language: text"]
        (group / path.name).write_text('r"""\n' + "\n".join(lines) + '\n"""\n' + thumbnail + body, encoding="utf-8")


def write_notebooks(source: Path, target: Path) -> None:
    """Every notebook as a Markdown page, with the output that it was saved with."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for path in sorted(source.glob("*.ipynb")):
        parts: list[str] = []
        for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
            text = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                parts.append(text)
                continue
            parts.append(f"```python\n{text}\n```")
            for place, output in enumerate(cell.get("outputs", [])):
                data = output.get("data", {})
                if "image/png" in data:
                    name = f"{path.stem}-{number}-{place}.png"
                    (target / name).write_bytes(base64.b64decode("".join(data["image/png"])))
                    parts.append(f"![What the cell above draws]({name})")
                elif shown := "".join(output.get("text", data.get("text/plain", []))).rstrip():
                    parts.append(f"```text\n{shown}\n```")
        (target / f"{path.stem}.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def plain(text: str) -> str:
    """Text in which stars, bars and underscores stand for themselves, outside of literals and roles."""
    pieces = re.split(r"(``[^`]*``|:\w+:`[^`]*`|`[^`]*`)", text)
    return "".join(
        piece if i % 2 else re.sub(r"(?<!\\)([*|])", r"\\\1", re.sub(r"(?<=\w)_(?!\w)", r"\\_", piece))
        for i, piece in enumerate(pieces)
    )


def docstring(_app: Any, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Docstrings are plain text with axes like (*batch, time): no emphasis; their examples stay as they are."""
    lines[:] = [line if line.lstrip().startswith((">>>", "...")) else plain(line) for line in lines]


def formula(self: Any, node: nodes.Element) -> None:
    """A formula as MathML, which browsers draw by themselves."""
    self.body.append(latex2mathml.tex2mathml(node.astext(), as_block=isinstance(node, nodes.math_block)))
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))
    app.connect("autodoc-process-docstring", docstring, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
