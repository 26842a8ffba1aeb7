"""Damage: bytes, values, structure and text of files as they should not be, for `fuzz.py`.

Each function takes the bytes of a file and a generator of random numbers, and gives other bytes.
"""

import bz2
import contextlib
import gzip
import io
import json
import lzma
import os
import re
import socket
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table

ODD_VALUES = ["nan", "inf", "-inf", "1e400", "1e30", "-1e30", "0", "-1", "1e-300", "''", "null",
              "true", "[]", "{}", "abc", "9" * 20, "1e23", "0x7f", "é", "~", "*"]  # fmt: skip
ODD_CARDS = ["1E30", "-1E30", "NaN", "'text'", "0.0", "T", "1.2.3", "", "1E400", "'unclosed",
             "(1.0, 2.0)", "99999999999999999999", "-5", "1E-300", "\x00\x01"]  # fmt: skip

# --- damage -------------------------------------------------------------------------------------


def flip(data, rng):
    data = bytearray(data)
    for bit in rng.integers(8 * len(data), size=rng.choice([1, 1, 1, 5])):
        data[bit // 8] ^= 1 << (bit % 8)
    return bytes(data)


def cut(data, rng):
    return data[: int(rng.integers(len(data)))]


def put_in(data, rng):
    at = int(rng.integers(len(data)))
    return data[:at] + rng.bytes(int(rng.integers(1, 50))) + data[at:]


def take_out(data, rng):
    at = int(rng.integers(len(data)))
    return data[:at] + data[at + int(rng.integers(1, 200)) :]


def double(data, rng):
    a, b = sorted(int(i) for i in rng.integers(len(data), size=2))
    return data[:b] + data[a : min(b, a + 3000)] + data[b:]


def blank(data, rng):
    at, n = int(rng.integers(len(data))), int(rng.integers(1, 500))
    return data[:at] + bytes(min(n, len(data) - at)) + data[at + n :]


def other_value(data, rng):
    """Another value for one of the numbers in the text of a file."""
    places = list(re.finditer(rb"(?<=[\s:,\[\"])-?\d+(\.\d+)?([eE][-+]?\d+)?", data[:40000]))
    if not places:
        return flip(data, rng)
    place = places[int(rng.integers(len(places)))]
    value = str(rng.choice(ODD_VALUES)).encode()
    return data[: place.start()] + value + data[place.end() :]


def other_line(data, rng):
    """A line that is missing, twice there, or has a name that is spelt otherwise."""
    lines = data.split(b"\n")
    k = int(rng.integers(min(len(lines), 300)))
    how = rng.integers(4)
    if how == 0:
        del lines[k]
    elif how == 1:
        lines.insert(k, lines[k])
    elif how == 2:
        lines[k] = lines[k].replace(b"a", b"e", 1)
    else:
        lines[k] = b" " + lines[k]
    return b"\n".join(lines)


def other_card(data, rng):
    """Another value for one of the cards of a FITS header."""
    starts = [i for i in range(0, min(len(data), 28800), 80) if data[i + 8 : i + 10] == b"= "]
    if not starts:
        return flip(data, rng)
    wcs = [i for i in starts if re.match(rb"C(TYPE|RVAL|RPIX|D|UNIT)|NAXIS|BITPIX|PV", data[i:])]
    i = int(rng.choice(wcs if wcs and rng.uniform() < 0.7 else starts))
    value = str(rng.choice(ODD_CARDS)).encode("latin-1")
    return data[: i + 10] + value.rjust(20).ljust(70)[:70] + data[i + 80 :]


def other_bytes(data, rng):
    """Nothing, noise, or the beginning of something else."""
    starts = [b"", b"\0" * 5000, b"#ASDF 1.0.0\n%YAML 1.1\n--- \n", b"SIMPLE  =", b"\x1f\x8b",
              b"BZh9", b"%PDF-1.5", b"<?xml version='1.0'?><VOTABLE>", b"\xff\xfe",
              b"# %ECSV 1.0\n",
              b"SIMPLE  =                    T".ljust(80) * 40]  # fmt: skip
    return starts[int(rng.integers(len(starts)))] + rng.bytes(int(rng.integers(0, 4000)))


# --- structure: what is whole in each of its parts, and wrong as a whole ------------------------


def other_hdus(data, rng):
    """FITS whose HDUs are missing, doubled, in another order, or have other names."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with fits.open(io.BytesIO(data), disable_image_compression=True) as hdus:
            places = [hdu.fileinfo() for hdu in hdus]
    parts = [data[p["hdrLoc"] : p["datLoc"] + p["datSpan"]] for p in places]
    how, k = int(rng.integers(6)), int(rng.integers(len(parts)))
    if how == 0:
        del parts[k]
    elif how == 1:
        parts.insert(int(rng.integers(len(parts) + 1)), parts[k])
    elif how == 2:
        rng.shuffle(parts)
    elif how == 3:
        parts[k] = parts[k].replace(b"EXTNAME = 'WPDC", b"EXTNAME = 'wpdc")
        parts[k] = parts[k].replace(
            b"EXTVER  =                    1", b"EXTVER  =                    7"
        )
    elif how == 4:
        parts[k] = re.sub(rb"XTENSION= '.{8}'", b"XTENSION= 'FOREIGN '", parts[k])
    else:
        parts[k] += parts[k][2880:]
    return b"".join(parts)


def other_column(data, rng):
    """FITS tables with columns of other names, types, scales and dimensions."""
    old, new = [
        (rb"(TTYPE\d+ *= ')\w+", rb"\1QQ"), (rb"(TFORM\d+ *= '\d*)[DEJKI]", rb"\1A"),
        (rb"(TFORM\d+ *= ')\d*[DEJKI] ", rb"\g<1>9D"),
        (rb"TUNIT(\d+) *= '.{8}'", rb"TSCAL\1  = 2.0       "),
        (rb"TUNIT(\d+) *= '.{8}'", rb"TZERO\1  = 1E30      "),
        (rb"TUNIT(\d+) *= '.{8}'", rb"TDIM\1   = '(7,9)'   "),
        (rb"TUNIT(\d+) *= '\w+", rb"TUNIT\1  = 'parsec"),
        (rb"TFIELDS = +(\d+)", rb"TFIELDS =                   99"),
        (rb"TFORM", b"TFURM"), (rb"(NAXIS2  = +)(\d)", rb"\g<1>1"),
    ][int(rng.integers(10))]  # fmt: skip
    found = list(re.finditer(old, data))
    if not found:
        return other_card(data, rng)
    match = found[int(rng.integers(len(found)))]
    put = match.expand(new)[: len(match[0])].ljust(len(match[0]))
    return data[: match.start()] + put + data[match.end() :]


def other_cards(data, rng):
    """Two cards exchanged, one twice with another value, one gone, or one of an odd form."""
    starts = [i for i in range(0, min(len(data), 28800), 80) if data[i + 8 : i + 10] == b"= "]
    if len(starts) < 2:
        return flip(data, rng)
    i, j = sorted(int(k) for k in rng.choice(starts, 2, replace=False))
    card = data[i : i + 80]
    odd = [
        data[j : j + 80], card[:10] + data[j + 10 : j + 80], b" " * 80, b"HIERARCH " + card[:71],
        b"CONTINUE  'more'".ljust(80), card.replace(b"E", b"D"), card.lower(),
        card[:8] + b" " + card[9:],
        b"END".ljust(80), card.replace(b".", b","), b"COMMENT " + card[:72], card[1:] + b" ",
    ][int(rng.integers(12))]  # fmt: skip
    if rng.uniform() < 0.5:
        return data[:i] + odd + data[i + 80 :]
    return data[:i] + data[j : j + 80] + data[i + 80 : j] + card + data[j + 80 :]


def other_text(data, rng):
    """Another line end, encoding or width, as editors, mail and file transfer leave them."""
    lines = data.split(b"\n")
    cut, k = int(rng.integers(40, 90)), int(rng.integers(len(lines)))
    text = data.decode("latin-1")
    return [
        lambda: data.replace(b"\n", b"\r\n"), lambda: data.replace(b"\n", b"\r"),
        lambda: b"\xef\xbb\xbf" + data, lambda: text.encode("utf-16"), lambda: text.encode("utf-8"),
        lambda: data.replace(b"  ", b"\t"), lambda: data.replace(b" ", b"\xa0"),
        lambda: b"\n".join(line[:cut] for line in lines), lambda: data.replace(b"\n", b"\n\n"),
        lambda: b"\n".join([*lines[k:], *lines[:k]]), lambda: data.upper(),
        lambda: data.replace(b"\n", b"\0\n"), lambda: data + data, lambda: data.replace(b".", b","),
        lambda: b"-----BEGIN-----\n" + data, lambda: data.replace(b"-", "\u2212".encode()),
    ][int(rng.integers(16))]()  # fmt: skip


def other_node(data, rng):
    """The tree of an ASDF file with values exchanged, keys renamed, nodes of other forms."""
    at = data.index(b"\nwpdc:") if b"\nwpdc:" in data else 0
    end = data.find(b"\n...", at)
    lines = data[at:end].split(b"\n")
    keyed = [k for k, line in enumerate(lines) if re.match(rb" +\w+: ?\S", line)]
    if len(keyed) < 2:
        return other_value(data, rng)
    i, j = (int(k) for k in rng.choice(keyed, 2, replace=False))
    (key, value), other = lines[i].split(b":", 1), lines[j].split(b":", 1)[1]
    space = key[: len(key) - len(key.lstrip())]
    lines[i] = [
        key + b":" + other, key + b": [" + value + b"]", key + b": !!str" + value,
        key + b": &a" + value,
        key + b": 1:30", key + b": 0x1F", key + b": 1_0", key + b": ~", key + b": .inf",
        key + b": {a: 1}",
        lines[i] + b"\n" + key + b":" + other, space + b"other:" + value, space + b"<<: {a: 1}",
        key + b": !!binary aGVsbG8=", key + b": !!set {a, b}", key + b": 2020-01-01",
        key + b":" + value * 2,
        key + b": *nothing", b"\t" + lines[i], key + b": !core/ndarray-1.1.0 [1, 2]",
        key + b":" + value.replace(b"-", b""), key + b": |\n" + space + b"  text",
    ][int(rng.integers(22))]  # fmt: skip
    return data[:at] + b"\n".join(lines) + data[end:]


def other_block(data, rng):
    """The header of a block of an ASDF file with another size, kind of compression or sum."""
    found = [m.start() for m in re.finditer(rb"\xd3BLK", data)]
    if not found:
        return put_in(data, rng)
    at = int(rng.choice(found))
    start, n = [(4, 2), (6, 4), (10, 4), (14, 8), (22, 8), (30, 8), (38, 16)][int(rng.integers(7))]
    put = [
        bytes(n),
        b"\xff" * n,
        rng.bytes(n),
        b"zlib"[:n].ljust(n, b"\0"),
        b"lz4\0"[:n].ljust(n, b"\0"),
    ]
    return data[: at + start] + put[int(rng.integers(5))] + data[at + start + n :]


def other_json(data, rng):
    """A manifest whose values are of other types, or name other files."""
    try:
        tree = json.loads(data)
    except ValueError:
        return flip(data, rng)
    node = tree
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = keys[int(rng.integers(len(keys)))]
        if not isinstance(node[key], dict | list) or not node[key] or rng.uniform() < 0.3:
            break
        node = node[key]
    odd = [None, 5, -1.5, True, "", "../../x", "solved", [], {}, ["x"], {"a": 1}, "1e999", "\ud800"]
    if rng.uniform() < 0.2 and isinstance(node, dict):
        del node[key]
    else:
        node[key] = odd[int(rng.integers(len(odd)))]
    return json.dumps(tree).encode()


LINES = [other_value, other_line, other_text, other_text]
TREE = [other_value, other_line, other_text, other_node, other_node, other_block]
TABLES = [other_hdus, other_column, other_cards]
ANY = [flip, cut, put_in, take_out, double, blank, other_bytes]
DAMAGE = {
    "wcs": [*ANY, *TREE, other_value, other_line],
    "solution": [*ANY, *TREE],
    "camera": [*ANY, *TREE],
    "fits": [*ANY, *TABLES, other_card],
    "cpdis": [*ANY, *TABLES, other_card],
    "image": [*ANY, other_card, other_card, other_cards, other_hdus],
    "ldac": [*ANY, *TABLES, other_card],
    "table": [*ANY, *LINES],
    "header": [*ANY, *LINES, other_card, other_cards],
    "catalog": [*ANY, *TABLES, other_card],
    "matches": [*ANY, *LINES],
    "summary": [*ANY, *LINES],
    "manifest": [*ANY, *LINES, other_json, other_json],
}


def odd_image(path, rng):
    """Images that are no sky: sizes, values and types."""
    shape = [(1, 1), (1, 300), (0, 5), (3, 3), (2, 64, 64), (64,), (64, 64)][int(rng.integers(7))]
    values = [0.0, np.nan, np.inf, 1e38, -1e30, 5.0][int(rng.integers(6))]
    data = np.full(shape, values, [np.float32, np.float64][int(rng.integers(2))])
    if rng.uniform() < 0.3:
        data = rng.integers(-30000, 30000, shape).astype(np.int16)
    header = fits.getheader(path)
    fits.writeto(path, data, header, overwrite=True, output_verify="ignore")


def odd_table(path, rng):
    """Catalogs with values that are none."""
    table = Table.read(path)
    name = str(rng.choice(table.colnames))
    odd = [np.nan, np.inf, -1e308, 1e5, 0.0, -91.0][int(rng.integers(6))]
    rows = rng.uniform(size=len(table)) < rng.choice([0.1, 1.0])
    how = int(rng.integers(4))
    if how == 0:
        table[name] = np.where(rows, odd, np.asarray(table[name], float))
    elif how == 1:
        table.remove_column(name)
    elif how == 2:
        table[name] = np.array(["text"] * len(table))
    else:
        table = table[: int(rng.integers(0, 4))]
    table.write(path, overwrite=True)


# What nobody means, by what it is made of.
ODD = {
    "place": ["image", "table", "catalog", "header", "wcs", "fits", "solution", "config", "mask",
              "weight-map"],
    "archive": ["image", "catalog", "fits"],
    "tree": ["wcs", "solution"],
    "list": ["table"],
}  # fmt: skip


def odd_place(folder, name, rng):
    """What is there and is no file of the kind: a folder, a pipe, a device, a link to itself."""
    path = folder / f"odd-{name}.fits"
    kind = str(rng.choice(["folder", "pipe", "socket", "loop", "nothing", "device", "endless"]))
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with contextlib.closing(socket.socket(socket.AF_UNIX)) as server:
            server.bind(os.path.relpath(path))
    elif kind in ("loop", "nothing"):
        path.symlink_to(path if kind == "loop" else folder / "nothing")
    else:
        return Path("/dev/null" if kind == "device" else "/dev/zero")
    return path


def odd_archive(data, rng):
    """Compressed once or twice, cut, with a wrong sum, or far larger than it looks."""
    packed = gzip.compress(data)
    return [
        packed[: int(rng.integers(1, len(packed)))],
        packed + b"more" * 100,
        packed[:-8] + bytes(8),
        gzip.compress(packed),
        gzip.compress(b""),
        gzip.compress(data[:5760] + bytes(100_000_000)),
        bz2.compress(data)[: int(rng.integers(1, 5000))],
        lzma.compress(data)[: int(rng.integers(1, 5000))],
    ][int(rng.integers(8))]


def odd_tree(data, rng):
    """ASDF with tags, types, shapes and sources that are other ones."""
    head, tree = data[: (at := data.index(b"\nwpdc:"))], data[at:]
    old, new = [
        (rb"datatype: float64", b"datatype: complex128"),
        (rb"datatype: float64", b"datatype: [ascii, 9]"),
        (rb"byteorder: little", b"byteorder: big"),
        (rb"source: \d+", b"source: 99"),
        (rb"source: \d+", b"source: -9"),
        (rb"source: \d+", b"source: other.asdf"),
        (rb"shape: \[\d+", b"shape: [-5"),
        (rb"shape: \[\d+", b"shape: [999999999999"),
        (rb"!core/ndarray-1.\d.0", b"!core/complex-1.0.0"),
        (rb"!core/ndarray-1.\d.0", b"!!python/object/apply:os.system"),
        (rb"\nwpdc:", b"\nwpdc: &w {wpdc: *w}\nother:"),
        (rb"\nwpdc:", b"\nwpdc: {$ref: 'http://127.0.0.1:9/a'}\nother:"),
        (rb"format_version: 1", b"format_version: 0"),
    ][int(rng.integers(13))]
    return head + re.sub(old, new, tree, count=1)


def odd_config(rng):
    """TOML that is none, or whose values are of other types."""
    return [
        b"r0 = [1, 2]", b"[r0]\na = 1", b"seed = 2020-01-01", b"seed = true", b"jobs = '2'",
        b"a = " + b"[" * 3000, b"a = " + b"[" * 200 + b"]" * 200, b"seed = 1\nseed = 2",
        b"\xff\xfe", b"\xef\xbb\xbfseed = 1", b"seed = " + b"9" * 5000, b"output = 5",
        b"n-grid = 50.5", b"a.b.c = 1", b"mask-bits = 'x'", b"x = '" + b"a" * 10_000_000 + b"'",
        b'detector = "\\u0000"', b"catalog = ['a', 'b']", b"min-snr = nan", b"frames = ['x']",
    ][int(rng.integers(20))]  # fmt: skip


def odd_list(data, rng):
    """ECSV whose header says what no table is."""
    old, new = [
        (b"ECSV 1.0", b"ECSV 9.7"), (b"float64", b"floaty"), (b"float64", b"object"),
        (b"float64", b"complex128"), (b"name: y", b"name: x"),
        (b"# datatype:", b"# delimiter: '@@'\n# datatype:"),
        (b"# datatype:", b"# meta: !!omap [1, 2]\n# datatype:"),
        (b"# datatype:", b"# meta: !!python/object/apply:os.system [x]\n# datatype:"),
        (b"# datatype:", b"# meta: " + b"[" * 5000 + b"\n# datatype:"),
        (b"# datatype:", b"# meta: {__serialized_columns__: 5}\n# datatype:"),
        (b"# -", b"#\t-"),
    ][int(rng.integers(11))]  # fmt: skip
    return data.replace(old, new) if rng.uniform() < 0.9 else data + b"1" * 10_000_000


MAKE = {"archive": odd_archive, "tree": odd_tree, "list": odd_list}
