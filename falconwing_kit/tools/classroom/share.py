"""Share: a flight and its hall -> one HTML file that opens by double click, without a network.

Scripts, styles, the player's data and the hall are inside the file. Its policy lets it run this one
script and nothing else, and forbids every request.
"""

import base64
import gzip
import hashlib
import html
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from falconwing_kit.aircraft.model import Model
from falconwing_kit.core.checks import InputError
from falconwing_kit.tools.classroom.results import FlightRecord, flight_data

PAGE = Path(__file__).parent / "page"
START = "share.js"  # the module that opens a shared file, by `openShared`
LARGEST_BYTES = 2_000_000  # of a shared file with the arena in it
IMPORT = re.compile(r'^import \{[^}]*\} from "\./([\w.-]+\.js)";[^\S\n]*(?://.*)?$', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const|let)\b)", re.MULTILINE)


def share_page(
    record: FlightRecord, scene_bytes: bytes | None, model: Model | None = None, name: str = ""
) -> str:
    """The page of a flight.

    Args:
        record: the flight, whose log is there.
        scene_bytes: the hall as the page's renderer loads it, packed or not; None draws a map.
        model: of the ghost; None for the kit's nominal model.
        name: of that model.

    Raises:
        FileNotFoundError: there is no log.
        InputError: it is no log of the kit, or holds neither states nor commands.
    """
    return page_of_data(flight_data(record, model, name), scene_bytes)


def page_of_data(data: Mapping[str, Any], scene_bytes: bytes | None) -> str:
    """The page of a player's data, as `results.flight_data` makes them.

    Args:
        data: the flight.
        scene_bytes: as for `share_page`.
    """
    what = "SIMULATION" if data["simulated"] else "Real flight"
    parts = [f"task {data['task']} {data['manoeuvre']}".strip(), f"seed {data['seed']}"]
    parts += [f"scene {data['scene']}"] if data["scene"] else []
    foot = (
        f"{what}: {', '.join(parts)}, FalconWing kit {data['kit']}. This file needs no network and"
        " sends nothing."
    )
    filled = {
        "TITLE": html.escape(f"{what}: {data['title']}"),
        "STYLE": (PAGE / "player.css").read_text(encoding="utf-8"),
        "FOOT": html.escape(foot),
        "FLIGHT": _packed(json.dumps(data, allow_nan=False, separators=(",", ":")).encode()),
        "SCENE": "" if scene_bytes is None else _packed(scene_bytes),
        "SCRIPT": '"use strict";\n' + inline_modules(START) + "\nopenShared();\n",
    }
    template = (PAGE / "share.html").read_text(encoding="utf-8")
    page = re.sub(r"__([A-Z]+)__", lambda found: filled.get(found[1], found[0]), template)
    return page.replace("__POLICY__", policy(page), 1)


def policy(page: str) -> str:
    """The content security policy of a page: its own script and style, by their digests."""

    def digests(tag: str) -> str:
        found = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        hashes = (hashlib.sha256(text.encode()).digest() for text in found)
        return " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in hashes)

    return (
        f"default-src 'none'; script-src {digests('script')}; style-src {digests('style')};"
        " worker-src blob:; img-src data:; base-uri 'none'; form-action 'none'"
    )


def inline_modules(start: str, folder: Path = PAGE) -> str:
    """A module and all that it imports as one script: imports and the word `export` left out.

    Args:
        start: the module's file name.
        folder: of all modules.

    Raises:
        InputError: a module is missing, imports in another form, or names something twice.
    """
    texts: dict[str, str] = {}

    def collect(name: str) -> None:
        if name in texts:
            return
        try:
            text = (folder / name).read_text(encoding="utf-8")
        except OSError:
            raise InputError(f"{name}: expected a module of the page, got none") from None
        texts[name] = ""  # a module that imports itself in a circle is read once
        for needed in IMPORT.findall(text):
            collect(needed)
        del texts[name]  # after what it needs
        texts[name] = EXPORT.sub("", IMPORT.sub("", text)).strip() + "\n"

    collect(start)
    _require_plain(texts)
    script = "\n".join(texts.values())
    if re.search(r"</script|<!--", script, re.IGNORECASE):
        raise InputError(f"{start}: expected a script without </script and <!--, got one")
    return script


def _require_plain(texts: Mapping[str, str]) -> None:
    """Raise InputError for an import that was not inlined, or a name of two modules."""
    owners: dict[str, str] = {}
    for name, text in texts.items():
        if left := re.search(r"^(import|export)\b.*$", text, re.MULTILINE):
            raise InputError(f"{name}: expected plain imports and exports, got {left[0]!r}")
        for made in _top_level_names(text):
            if owners.setdefault(made, name) != name:
                raise InputError(f"{made}: expected one module with it, got {owners[made]}, {name}")


def _top_level_names(text: str) -> Iterable[str]:
    return re.findall(r"^(?:async )?(?:function|class|const|let)\s+([A-Za-z_$][\w$]*)", text, re.M)


def _packed(content: bytes) -> str:
    """Base64 of gzip; content that is packed already stays as it is."""
    packed = content if content[:2] == b"\x1f\x8b" else gzip.compress(content, 9, mtime=0)
    return base64.b64encode(packed).decode()
