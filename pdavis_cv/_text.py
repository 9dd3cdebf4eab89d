"""Text of others, such as a file's, as it may reach a terminal or a table."""
from __future__ import annotations

import re
from typing import Any

MOST_TEXT = 2000
"""Most characters of an error or a warning."""
_PLAIN = re.compile(r"[\n\t -~]*")


def shown(text: str, most: int | None = None) -> str:
    r"""Return a text without what controls a terminal: ``ESC`` becomes ``\x1b``.

    Parameters
    ----------
    text : str
    most : int, optional
        Most characters; their number follows if there are more.

    Examples
    --------
    >>> print(shown("\x1b[31mred\u202e", 8))
    \x1b[31mred ... (9 characters)
    """
    more = "" if most is None or len(text) <= most else f" ... ({len(text)} characters)"
    text = text[:most] if more else text
    if not _PLAIN.fullmatch(text):
        text = "".join(one if one.isprintable() or one in "\n\t" else
                       one.encode("unicode_escape").decode() for one in text)
    return text + more


class Shown:
    """A text stream that is written to by `shown`; else the stream itself."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text; carriage returns, of progress bars, pass."""
        self._stream.write("\r".join(map(shown, text.split("\r"))))
        return len(text)


def drawn(text: str) -> str:
    r"""Return a text that matplotlib draws as it is: ``$`` begins no formula.

    Examples
    --------
    >>> print(drawn("$x_{"), drawn("_a"))
    \$x_{  _a
    """
    # Names that begin with _ are left out of legends.
    return " " * text.startswith("_") + shown(text).replace("$", r"\$")


def page_text(value: Any) -> str:
    """Return a value as text in a page's elements or attributes."""
    import html  # slow to import
    return html.escape(shown(str(value)))


def for_script(value: Any) -> str:
    """Return a value as JSON inside a page's script, which no text in it can end."""
    import json  # slow to import
    return json.dumps(value).replace("<", "\\u003c")


def table_text(text: str) -> str:
    """Return a text as a cell that no spreadsheet takes for a formula."""
    text = shown(text)
    if text[:1] not in [*"=+-@\t\n\uff1d\uff0b\uff0d\uff20"]:
        return text
    try:
        float(text)
    except ValueError:
        return "'" + text
    return text
