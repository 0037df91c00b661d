"""Every file has a licence, every licence its full text, every data file a row, and the citation
is complete.

REUSE.toml is read here by the rules of the REUSE specification 3.3: `*` is anything but a slash,
`**` anything, the last table that fits a path counts. (`reuse lint` reads it too, but is not
installed with the kit.)
"""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

from falconwing_kit import __version__
from tests.house.test_public import tracked_files

ROOT = Path(__file__).resolve().parents[2]
DATA = "falconwing_kit/data"
FULL_TEXTS = {  # of each licence, words of its middle and end; so a pointer to it is no full text
    "MIT": ("The above copyright notice", "OTHER DEALINGS IN THE"),
    "Apache-2.0": ("Grant of Patent License", "limitations under the License"),
    "BSD-3-Clause": ("Neither the name", "POSSIBILITY OF SUCH DAMAGE"),
    "CC-BY-4.0": ("Section 3", "Creative Commons may be contacted"),
    "CC0-1.0": ("Affirmer", "no duty or obligation"),
    "CERN-OHL-P-2.0": (
        "Copying, modifying and Conveying Covered Source",
        "third party beneficiary rights",
    ),
}


def licences(root: Path, names: list[str]) -> dict[str, str]:
    """SPDX expression of each path by REUSE.toml; "" for none."""
    tables = tomllib.loads((root / "REUSE.toml").read_text(encoding="utf-8"))["annotations"]
    found = dict.fromkeys(names, "")
    for table in tables:
        paths = [table["path"]] if isinstance(table["path"], str) else table["path"]
        for pattern in map(as_expression, paths):
            for name in names:
                if pattern.fullmatch(name):
                    found[name] = table["SPDX-License-Identifier"]
    return found


def as_expression(path: str) -> re.Pattern[str]:
    """A path of REUSE.toml as a regular expression."""
    parts = {"**": ".*", "*": "[^/]*"}
    words = re.split(r"(\*+)", path)
    return re.compile("".join(parts.get(word, re.escape(word)) for word in words))


def data_problems(root: Path, names: list[str]) -> list[str]:
    """Data files without a row in data/README.md, rows without a file, other licences in both."""
    page = (root / DATA / "README.md").read_text(encoding="utf-8")
    rows = [line.strip("|").split("|") for line in page.splitlines() if line.startswith("| `")]
    stated = {name: row[-1].strip() for row in rows for name in re.findall(r"`([^`]+)`", row[0])}
    shipped = {}
    for name, licence in licences(root, names).items():
        if name.startswith(DATA + "/"):
            head, slash, _ = name.removeprefix(DATA + "/").partition("/")
            shipped[head + slash] = licence
    problems = [f"{name}: no row" for name in sorted(shipped.keys() - stated.keys())]
    problems += [f"{name}: no such file" for name in sorted(stated.keys() - shipped.keys())]
    return problems + [
        f"{name}: {stated[name]} in the row, {shipped[name]} in REUSE.toml"
        for name in sorted(shipped.keys() & stated.keys())
        if stated[name] != shipped[name]
    ]


@pytest.fixture(scope="module")
def names():
    return [path.relative_to(ROOT).as_posix() for path in tracked_files(ROOT)]


def test_every_file_has_a_licence_and_every_licence_its_full_text(names):
    """The specification's two conditions; texts not in use would mislead."""
    found = licences(ROOT, names)
    assert [name for name, licence in found.items() if not licence] == []
    used = {word for text in found.values() for word in re.split(r" (?:AND|OR) ", text)}
    texts = {path.stem for path in (ROOT / "LICENSES").glob("*.txt")}
    assert used == texts == set(FULL_TEXTS)
    for name, words in FULL_TEXTS.items():
        text = " ".join((ROOT / f"LICENSES/{name}.txt").read_text(encoding="utf-8").split())
        assert all(word in text for word in words), name
    assert (ROOT / "LICENSE").read_text() == (ROOT / "LICENSES/MIT.txt").read_text()


@pytest.mark.parametrize(
    ("name", "licence"),
    [
        ("falconwing_kit/core/frames.py", "MIT"),
        ("firmware/README.md", "MIT"),
        ("manual/glossary.md", "CC-BY-4.0"),
        ("manual/figures/make_figures.py", "CC-BY-4.0 OR MIT"),
        ("labs/lab01_sizing/lab.py", "CC-BY-4.0 OR MIT"),
        ("hardware/bracket/bracket.py", "CERN-OHL-P-2.0"),
        ("hardware/jig/balance_jig.stl", "CERN-OHL-P-2.0"),
        (f"{DATA}/sport_cub.csv", "Apache-2.0"),
        (f"{DATA}/alfa_engine_failure.csv", "BSD-3-Clause"),
        (f"{DATA}/hall_clip/000.jpg", "CC0-1.0"),
        (f"{DATA}/case08_flight.csv", "MIT"),
    ],
)
def test_the_licence_of_a_place(name, licence):
    """By hand from LICENSES.md."""
    assert licences(ROOT, [name])[name] == licence


def test_every_data_file_has_a_row_with_its_licence(names):
    """What it is, how it was made, under which licence."""
    assert data_problems(ROOT, names) == []


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda page, names: (page, [*names, f"{DATA}/new.csv"]), "new.csv: no row"),
        (
            lambda page, names: (page, [n for n in names if "leader" not in n]),
            "leader.npz: no such",
        ),
        (
            lambda page, names: (page.replace("Apache-2.0 |", "MIT |"), names),
            "sport_cub.csv: MIT in the row",
        ),
    ],
)
def test_a_planted_gap_is_reported(tmp_path, names, change, problem):
    """A file without a row, a row without a file, a row with another licence."""
    (tmp_path / DATA).mkdir(parents=True)
    page, changed = change((ROOT / DATA / "README.md").read_text(encoding="utf-8"), names)
    (tmp_path / DATA / "README.md").write_text(page)
    (tmp_path / "REUSE.toml").write_text((ROOT / "REUSE.toml").read_text())
    assert any(line.startswith(problem) for line in data_problems(tmp_path, changed))


def test_data_of_others_states_the_same_licence():
    """The fact files beside the flights, against REUSE.toml."""
    for name in ("alfa_engine_failure", "sport_cub"):
        facts = tomllib.loads((ROOT / DATA / f"{name}.toml").read_text(encoding="utf-8"))["source"]
        path = f"{DATA}/{name}.csv"
        assert facts["licence"] == licences(ROOT, [path])[path]
        assert (ROOT / DATA / facts["licence_file"]).is_file()


def test_names_of_others_are_theirs():
    """One paragraph: independent of the paper's authors, trademarks of their owners."""
    page = " ".join((ROOT / "LICENSES.md").read_text(encoding="utf-8").split())
    assert "This kit is independent work" in page and "neither made nor checked nor endorse" in page
    assert "trademarks of their owners" in page
    product_names = {"UMX", "Turbo Timber", "Spektrum", "RunCam", "Arducam", "Arduino"}
    assert all(name in page for name in product_names)


def test_wheel_names_every_licence(names):
    """pyproject's expression is the licences in use, joined."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert set(project["license"].split(" AND ")) == set(FULL_TEXTS)
    assert "LICENSES/*.txt" in project["license-files"]


def test_citation_is_complete():
    """The fields that the Citation File Format 1.2.0 requires and the paper as it is cited; dates
    and links come with a release.
    """
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    for key in ("cff-version", "message", "title", "authors", "abstract", "keywords", "license"):
        assert cited[key], key
    assert cited["version"] == __version__ and set(cited["license"]) == set(FULL_TEXTS)
    paper = cited["references"][0]
    assert [author["family-names"] for author in paper["authors"]] == [
        "Miao",
        "Shen",
        "Cui",
        "Mitra",
    ]
    assert paper["year"] == 2025 and paper["identifiers"][0]["value"] == "arXiv:2505.01383"
