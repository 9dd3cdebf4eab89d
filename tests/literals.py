"""Numeric literals of source files, and whether each has a name that says what it is.

``python tests/literals.py FILE ...`` lists the ones that do not.
"""
import ast
import io
import re
import sys
import tokenize
from pathlib import Path
from typing import NamedTuple

TRIVIAL = {0.0, 1.0, 2.0, 3.0, 4.0, 0.5, 0.25}
"""Counts of dimensions and channels, halves and quarters; not as bounds."""
UNITS = {1e-6, 1e-3, 1e3, 1e6}
"""Factors between units, which stand beside a sign of multiplication or division."""
BOUNDING = {"max", "min", "maximum", "minimum", "fmax", "fmin", "clip"}
"""Functions whose arguments are bounds, of which only 0 and 1 need no name."""
LARGEST_INDEX = 16
"""Integers up to it, of four channels squared, may be an index or a length."""

NUMBER = re.compile(
    r"(?<![\w.])(0[xX][0-9a-fA-F]+|(?:\d[\d_]*\.?[\d_]*|\.\d[\d_]*)(?:[eE][+-]?\d+)?)"
    r"[fFlLuU]*(?![\w.])")
NAME = re.compile(r"_?[A-Z][A-Z0-9_]*$")
# Declarations with a name: of C, of numbers in a kernel, of an enum.
KERNEL_NAME = re.compile(
    r"\s*(?:#\s*define\s+[A-Z]\w*\s|(?:static\s+)?const\s+\w+\s+\w+(\[\w*\])*\s*="
    r"|cdef\s+(?:const\s+)?(?:float|double)\s+(?:\w+\s*=\s*[-+.\deE]+[,\s]*)+$"
    r"|_?[A-Z][A-Z0-9_]*\s*=)")
INDEX = re.compile(r"\[[^\]]*\]|\.shape\b.*")


class Literal(NamedTuple):
    """One number: where, its text, its line, what its name says ('' without), use."""

    path: Path
    line: int
    text: str
    source: str
    name: str
    said: str
    bound: bool = False

    def __str__(self):
        return f"{self.path}:{self.line}: {self.text}   {self.source.strip()}"


def literals(path):
    """Return the literals of a file that are not trivial."""
    text = Path(path).read_text()
    found = python(path, text) if Path(path).suffix == ".py" else kernel(path, text)
    return [one for one in found if not trivial(one)]


def trivial(one):
    """Return whether a number needs no name."""
    number = value(one.text)
    if one.bound:
        return number in (0, 1)
    text = re.escape(one.text)
    return number in TRIVIAL or (number in UNITS and re.search(
        rf"[*/]\s*{text}(?![\w.])|(?<![\w.]){text}\s*[*/]", one.source) is not None)


def value(text):
    text = text.rstrip("fFlLuU") if not text.lower().startswith("0x") else text
    return float(int(text, 0)) if text.lower().startswith("0x") else float(
        text.replace("_", ""))


def python(path, text):
    """Literals of Python: a name is a constant of a module or class."""
    tree, lines = ast.parse(text), text.splitlines()
    comments = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT}
    indices = {id(number) for node in ast.walk(tree) if isinstance(node, ast.Subscript)
               for number in ast.walk(node.slice) if isinstance(number, ast.Constant)
               and isinstance(number.value, int) and number.value <= LARGEST_INDEX}
    bounds = {id(number) for node in ast.walk(tree) if isinstance(node, ast.Call)
              and getattr(node.func, "id", getattr(node.func, "attr", "")) in BOUNDING
              for number in node.args}
    named = {}
    for body in [tree.body, *(node.body for node in ast.walk(tree)
                              if isinstance(node, ast.ClassDef))]:
        about = "" if body is tree.body else doc_of(body)
        for i, node in enumerate(body):
            for number, name in constants(node):
                after = body[i + 1] if i + 1 < len(body) else None
                said = [comments.get(k, "") for k in range(
                    node.lineno, node.end_lineno + 1)]
                k = node.lineno - 1
                while k in comments and lines[k - 1].lstrip().startswith("#"):
                    said.insert(0, comments[k])
                    k -= 1
                if isinstance(after, ast.Expr) and isinstance(
                        after.value, ast.Constant) and isinstance(
                        after.value.value, str):
                    said.append(after.value.value)
                said.append(about)
                named[number] = name, " ".join(filter(None, said))
    return sorted(Literal(path, node.lineno, ast.get_source_segment(text, node),
                    lines[node.lineno - 1], *named.get(id(node), ("", "")),
                    id(node) in bounds)
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and type(node.value) in (int, float)
            and id(node) not in indices)


def doc_of(body):
    """Return the docstring of a class, which describes its fields."""
    first = body[0]
    documented = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    return str(first.value.value) if documented else ""


def constants(node):
    """Yield (identity of a number, name) of the assignment of a constant."""
    if isinstance(node, ast.Assign):
        targets, right = node.targets, node.value
    elif isinstance(node, ast.AnnAssign) and node.value is not None:
        targets, right = [node.target], node.value
    else:
        return
    names = [name.id for target in targets for name in ast.walk(target)
             if isinstance(name, ast.Name)]
    # A field of a dataclass or named tuple has a name too: its class documents it.
    if names and all(NAME.match(name) or isinstance(node, ast.AnnAssign)
                     for name in names):
        for number in ast.walk(right):
            if isinstance(number, ast.Constant):
                yield id(number), ", ".join(names)


def kernel(path, text):
    """Literals of Cython and of the C inside it: a name is one of a declaration."""
    code, comments = stripped(text, header=Path(path).suffix == ".h")
    found, before = [], ""
    for k, line in enumerate(code.splitlines(), 1):
        said = comments.get(k, "")
        indices = {k for m in INDEX.finditer(line) for k in range(*m.span())}
        numbers = [m.group(1) for m in NUMBER.finditer(line)
                   if not (m.start() in indices and m.group(1).isdigit()
                           and int(m.group(1)) <= LARGEST_INDEX)]
        if not line.strip():
            before = f"{before} {said}".strip() if said else ""
            continue
        name = ""
        if declared := KERNEL_NAME.match(line):
            name = declared.group().split("=")[0].split()[-1].split("[")[0]
        found += [Literal(path, k, number, text.splitlines()[k - 1], name,
                          f"{before} {said}".strip() if name else "")
                  for number in numbers]
        # What stands over a list of names is about all of them.
        if line.lstrip().startswith("cdef enum"):
            before = f"{before} {said}".strip()
        elif not name:
            before = said
    return found


def stripped(text, header=False):
    """Return Cython without comments, strings and docstrings, and the comments.

    The C of ``cdef extern from *`` stays, and that of a header, which is C throughout.
    """
    out, comments, i, line = [], {}, 0, 1
    # The quote that ends the C we are in; nothing ends a header.
    verbatim = "\0" if header else None

    def skip(stop):
        nonlocal i, line
        out.append("".join(c if c == "\n" else " " for c in text[i:stop]))
        line += text.count("\n", i, stop)
        i = stop

    def note(stop, strip):
        for k, part in enumerate(text[i:stop].split("\n")):
            if part.strip(strip):
                comments[line + k] = (
                    comments.get(line + k, "") + " " + part.strip(strip)).strip()
        skip(stop)

    while i < len(text):
        if verbatim is not None and text.startswith(verbatim, i):
            skip(i + 3)
            verbatim = None
        elif verbatim is None and text[i] == "#":
            note(text.find("\n", i) % (len(text) + 1), "# \t")
        elif verbatim is not None and text.startswith("/*", i):
            note(text.index("*/", i) + 2, "/* \t")
        elif verbatim is not None and text.startswith("//", i):
            note(text.index("\n", i), "/ \t")
        elif verbatim is None and text[i:i + 3] in ('"""', "'''"):
            if re.search(r"cdef extern from \*[^\n]*:\s*$", text[:i]):
                verbatim = text[i:i + 3]
                skip(i + 3)
            else:
                skip(text.index(text[i:i + 3], i + 3) + 3)
        elif text[i] in "\"'" and verbatim is None:
            stop = i + 1
            while text[stop] != text[i]:
                stop += 2 if text[stop] == "\\" else 1
            skip(stop + 1)
        else:
            out.append(text[i])
            line += text[i] == "\n"
            i += 1
    return "".join(out), comments


def bare(path):
    """Return the literals of a file without a name, or whose name says nothing."""
    return [one for one in literals(path) if len(one.said.split()) < 3]


if __name__ == "__main__":
    for name in sys.argv[1:]:
        for one in bare(name):
            print(one, f"   (named {one.name}, nothing said)" if one.name else "")
