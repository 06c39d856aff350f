"""Records that print as a few lines, and as a small table in a notebook."""

from __future__ import annotations

from html import escape


class Printed:
    """A record that says of itself what :meth:`_rows` holds, name by name, in one line or several, under its class."""

    def _rows(self) -> dict[str, str]:
        raise NotImplementedError

    def __repr__(self) -> str:
        rows = self._rows()
        width = max(map(len, rows))
        further = "\n" + " " * (width + 4)
        lines = (f"  {name:<{width}}  {words}".replace("\n", further) for name, words in rows.items())
        return "\n".join([type(self).__name__, *lines])

    def _repr_html_(self) -> str:
        plain = ((escape(name), "<br>".join(escape(words).split("\n"))) for name, words in self._rows().items())
        rows = "".join(f"<tr><th>{name}</th><td>{words}</td></tr>" for name, words in plain)
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"
