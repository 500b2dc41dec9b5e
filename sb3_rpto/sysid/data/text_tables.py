"""Tables of text as common tools write them: where the header is, what parts the columns, how decimals are written."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sb3_rpto.effects.names import near
from sb3_rpto.sysid.data.columns import PLAIN, PREFIXES, read_columns

#: What comments begin with, and the header of NumPy's or MATLAB's tables.
MARKS = "#%"
TEXT = ("episode", "split")
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
#: 0,5 or -1,5e-3; 1,234 or 12,345,678, which may count thousands as well.
_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?|[+-]?\d+,([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|nan|[+-]?inf", re.IGNORECASE)
_POINT = re.compile(r"[+-]?(\d+\.\d*|\.\d+)([eE][+-]?\d+)?")
#: Units of the format as they are written, in lower case, and which columns have them.
_SI = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "time"),
    **dict.fromkeys(("rad", "m", "metre", "metres", "meter", "meters", "radian", "radians"), "qpos"),
    **dict.fromkeys(("rad/s", "m/s", "rad*s^-1", "m*s^-1"), "qvel"),
    **dict.fromkeys(("n", "nm", "n*m"), "qfrc"),
}
_NO_UNIT = ("", "-", "1", "none", "n/a")
#: Those of other tables.
_OTHER_UNITS = (
    "ms msec us ns min h milliseconds microseconds nanoseconds deg ° degree degrees rev revs turns counts ticks mrad "
    "deg/s °/s degrees/s rpm rev/s mrad/s mm cm um in inch mm/s cm/s nmm n*mm ncm n*cm mnm mn*m"
)
_OTHERS = frozenset(_OTHER_UNITS.split())


def read_text(path: str, rename: Mapping[str, str] | None = None) -> dict[str, np.ndarray]:
    """A table's columns as text, decimals with points: NumPy makes the nearest floats of it, faster parsers may not.

    The header may stand behind a mark of comments (``# time,qpos.hinge``, as of ``np.savetxt``; ``%`` of MATLAB) and
    above a row of units; commas, semicolons, tabs or blanks part the columns, and lines may end with one.

    :param path: of a file in UTF-8, or in UTF-16 with its mark, also gzipped
    :param rename: see :func:`renamed`
    :raises ValueError: an empty or broken file, no header, rows of another length, units that are not SI's, commas that
        may be decimals or thousands; see :func:`sb3_rpto.sysid.data.columns.read_columns`, too
    """
    lines = [line for line in re.split(r"\r\n|\r|\n", _text(path)) if line.strip()]
    if lines and re.fullmatch(r"sep=.", lines[0].strip()):  # of spreadsheets
        lines.pop(0)
    if not lines:
        raise ValueError(f"{path}: the file is empty; give a header and one row a sample")
    header, body = _header(path, lines)
    (names,) = _split(path, [header], _delimiter(header))
    names = [name.strip("'\"").strip() for name in names]
    mark = _delimiter_of_rows(path, header, body, len(names))
    rows = [*_split(path, body, mark)]
    while names and not names[-1] and all(len(row) < len(names) or not row[len(names) - 1] for row in rows):
        names.pop()  # the line ended with a mark
    count = len(names)
    names = renamed(names, rename, path)
    rows = [row for row in rows if len(row) == count or not row[0].startswith(tuple(MARKS))]
    rows = [row[:count] if not any(row[count:]) else row for row in rows]
    names = [_unit_of_name(path, name) for name in names]
    read_columns(names, path)
    if rows and len(rows[0]) == count and _are_units(names, rows[0]):
        for name, unit in zip(names, rows.pop(0)):
            _check_unit(path, name, unit)
    for number, row in enumerate(rows):
        if len(row) != count:
            more = len(row) > count and mark == ","
            remedy = (
                "write decimals with points, or part the columns by semicolons, where these are decimal commas"
                if more
                else "correct that row"
            )
            raise ValueError(f"{path}: row {number} has {len(row)} fields, the header {count}; {remedy}")
    cells = np.array([[cell or "nan" for cell in row] for row in rows], dtype=str).reshape(-1, count)
    numeric = [i for i, name in enumerate(names) if name not in TEXT]
    columns = {name: cells[:, i] for i, name in enumerate(names)}
    if any("," in cell for i in numeric for cell in cells[:, i]):
        columns |= _with_points(path, {names[i]: cells[:, i] for i in numeric})
    return columns


def renamed(names: Sequence[str], rename: Mapping[str, str] | None, file: str) -> list[str]:
    """Names of columns, some of which are called otherwise in the file.

    :param names: of the file's columns
    :param rename: the format's name by the file's, such as ``{"q1": "qpos.shoulder"}``
    :param file: for the messages
    :raises TypeError: ``rename`` is no mapping of names
    :raises ValueError: it names a column that the file does not have, or one twice
    """
    if rename is None:
        return [*names]
    if not isinstance(rename, Mapping) or not all(isinstance(n, str) for pair in rename.items() for n in pair):
        raise TypeError(f"rename must be a dict of names such as {{'q1': 'qpos.shoulder'}}, not {rename!r}")
    for old in rename:
        if old not in names:
            raise ValueError(f"{file}: rename: there is no column {old!r}; {near(old, [*map(str, names)])}")
    found = [rename.get(name, name) for name in names]
    for old, new in rename.items():
        if found.count(new) > 1:
            raise ValueError(
                f"{file}: rename: {old!r} would be {new!r}, which another column is, too; rename or drop one"
            )
    return found


def parse_rename(text: str) -> dict[str, str]:
    """``t=time,q1=qpos.shoulder`` as a dict; names may have a ``=``, as the new one is told by its beginning.

    :raises ValueError: an entry of another form, a name twice
    """
    found: dict[str, str] = {}
    for entry in (part.strip() for part in text.split(",") if part.strip()):
        parts = entry.split("=")
        pairs = [("=".join(parts[:i]).strip(), "=".join(parts[i:]).strip()) for i in range(1, len(parts))]
        known = [(old, new) for old, new in pairs if old and _is_column(new)]
        if not known:
            raise ValueError(
                f"{entry!r} is not OLD=NEW with NEW one of {', '.join(PLAIN)} or what begins with "
                f"{', '.join(prefix + '.' for prefix in PREFIXES)}, such as q1=qpos.shoulder"
            )
        if known[0][0] in found:
            raise ValueError(f"{known[0][0]!r} is there twice; name each column once")
        found[known[0][0]] = known[0][1]
    return found


def _is_column(name: str) -> bool:
    prefix, _, rest = name.partition(".")
    return name in PLAIN or (prefix in PREFIXES and bool(rest))


def _text(path: str) -> str:
    opener = gzip.open if path.endswith(".gz") else open
    try:
        with opener(path, "rb") as stream:
            content: bytes = stream.read()
        return content.decode("utf-16" if content.startswith(_UTF16) else "utf-8-sig")
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise ValueError(f"{path}: no whole gzip file ({error}); write it again") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: no text in UTF-8 ({error}); save the table as CSV in UTF-8") from error


def _header(path: str, lines: Sequence[str]) -> tuple[str, list[str]]:
    """The line of names, and those below it; the last comment is it where numbers follow."""
    first = next((i for i, line in enumerate(lines) if not line.lstrip().startswith(tuple(MARKS))), len(lines))
    if first < len(lines) and not _is_row(lines[first]):
        header, below = lines[first], first + 1
        marked = first > 0 and _are_units_line(lines[first])  # units below names behind a mark
        return (_unmarked(lines[first - 1]), [*lines[first:]]) if marked else (header, [*lines[below:]])
    if first == 0:
        raise ValueError(
            f"{path}: the first line holds numbers; put a header of names above it, such as time,qpos.hinge,ctrl.motor"
        )
    names = first - 1
    if first > 1 and _are_units_line(_unmarked(lines[names])):  # behind a mark as well
        return _unmarked(lines[names - 1]), [_unmarked(lines[names]), *lines[first:]]
    return _unmarked(lines[names]), [*lines[first:]]


def _unmarked(line: str) -> str:
    return line.lstrip().lstrip(MARKS)


def _is_row(line: str) -> bool:
    """Whether a line holds values: half of its cells, at least, are numbers, decimal commas or not."""
    cells = [cell.strip().replace(",", ".") for cell in next(csv.reader([line], delimiter=_delimiter(line)))]
    return 2 * sum(bool(_NUMBER.fullmatch(cell)) for cell in cells) >= len(cells)


def _are_units_line(line: str) -> bool:
    cells = [cell.strip() for cell in next(csv.reader([line], delimiter=_delimiter(line), skipinitialspace=True))]
    units = [_plain_unit(cell) for cell in cells]
    return all(u in _SI or u in _OTHERS or u in _NO_UNIT for u in units) and any(u not in _NO_UNIT for u in units)


def _delimiter(header: str) -> str:
    outside = re.sub(r'"[^"]*"', "", header)
    for mark in "\t;,":
        if mark in outside.strip():
            return mark
    return " " if len(outside.split()) > 1 else ","


def _delimiter_of_rows(path: str, header: str, rows: Sequence[str], count: int) -> str:
    """The header's, unless the rows have another: ``np.savetxt`` parts them by blanks where nothing else is said."""
    own = _delimiter(header)
    first = next((row for row in rows if _is_row(row)), None)
    if first is None or len(next(_split(path, [first], own))) >= count:
        return own
    other = _delimiter(first)
    return other if len(next(_split(path, [first], other))) == count else own


def _split(path: str, lines: Sequence[str], mark: str) -> Iterator[list[str]]:
    """The cells of lines without the blanks around them."""
    lines = [line.strip() for line in lines] if mark == " " else lines
    try:
        for row in csv.reader(lines, delimiter=mark, skipinitialspace=True):
            yield [cell.strip() for cell in row]
    except csv.Error as error:
        raise ValueError(
            f"{path}: no CSV ({error}); is a quote left open, or its end torn? Correct that row"
        ) from error


def _plain_unit(text: str) -> str:
    inner = text.strip().strip("[]()'\"").strip().lower()
    return re.sub(r"\s*[·⋅*\s]\s*", "*", inner).replace("µ", "u").replace("μ", "u").replace("º", "°")


def _are_units(names: Sequence[str], row: Sequence[str]) -> bool:
    """Whether the row below a header says units: no numbers, and where it says something of times or joints, units."""
    if any(_NUMBER.fullmatch(cell.replace(",", ".")) for cell in row if cell not in _NO_UNIT):
        return False
    own = [_plain_unit(c) for n, c in zip(names, row) if n == "time" or n.startswith(("qpos.", "qvel."))]
    known = [unit in _SI or unit in _OTHERS for unit in own if unit not in _NO_UNIT]
    return bool(known) and all(known)


def _check_unit(path: str, name: str, unit: str) -> None:
    """Refuse a unit that is not the format's.

    :raises ValueError: with what to give
    """
    plain, prefix = _plain_unit(unit), name.partition(".")[0]
    wanted = {"time": "s", "qpos": "rad (or m)", "qvel": "rad/s (or m/s)", "qfrc": "N·m (or N)"}.get(prefix)
    if wanted is not None and plain not in _NO_UNIT and _SI.get(plain) != prefix:
        raise ValueError(f"{path}: the units say {unit!r} of column {name!r}; give it in {wanted}, and say so there")


def _unit_of_name(path: str, name: str) -> str:
    """``time [s]`` without its unit, which is checked; another name as it is."""
    found = re.fullmatch(r"(.*\S)\s+[\[(]([^\[\]()]*)[\])]|(time)[\[(]([^\[\]()]*)[\])]", name)
    if found is None:
        return name
    bare, unit = (found[1], found[2]) if found[1] else (found[3], found[4])
    plain = _plain_unit(unit)
    if not _is_column(bare) or not (plain in _SI or plain in _OTHERS or plain in _NO_UNIT):
        return name
    _check_unit(path, bare, unit)
    return bare


def _with_points(path: str, columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of numbers with decimal commas, written with points.

    :raises ValueError: the commas may be others
    """
    with_commas = [(name, cell) for name, cells in columns.items() for cell in cells.tolist() if "," in cell]
    others = [cell for cells in columns.values() for cell in cells.tolist() if _POINT.fullmatch(cell)]
    odd = next(((name, cell) for name, cell in with_commas if not _COMMA.fullmatch(cell)), None)
    if odd is None and others:
        odd = with_commas[0]
    if odd is not None or all(_THOUSANDS.fullmatch(cell) for _, cell in with_commas):
        name, cell = odd or with_commas[0]
        beside = f" beside {others[0]!r}" if others else ""
        raise ValueError(
            f"{path}: column {name!r} holds {cell!r}{beside}: is its comma a decimal's or one of thousands? Write "
            "decimals with a point, and no marks of thousands"
        )
    return {name: np.char.replace(cells, ",", ".") for name, cells in columns.items()}
