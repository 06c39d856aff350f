"""Records that print as a few lines, and as a small table in a notebook."""

from __future__ import annotations

from html import escape


class Printed:
    """A record that says of itself what :meth:`_rows` holds, under its class's name."""

    def _rows(self) -> dict[str, str]:
        raise NotImplementedError

    def __repr__(self) -> str:
        rows = self._rows()
        width = max(map(len, rows))
        return "\n".join([type(self).__name__, *(f"  {name:<{width}}  {words}" for name, words in rows.items())])

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(w)}</td></tr>" for name, w in self._rows().items())
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"
