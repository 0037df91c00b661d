"""The gallery shows every figure with the command that makes it and the words beside it."""

import re

from tests.manual.book import MANUAL, ROOT, script

GALLERY = (MANUAL / "gallery.md").read_text(encoding="utf-8")
ENTRY = re.compile(
    r"^!\[([^\]]+)\]\(figures/([\w.]+)\)\n\n`([^`]+)`\n\n(.*?)\n\n", re.MULTILINE | re.DOTALL
)


def test_every_figure_is_shown_once_in_its_own_words():
    """The folder's images against the page; the words are those of the file beside the image."""
    entries = ENTRY.findall(GALLERY)
    pictures = {
        path.name
        for path in (MANUAL / "figures").iterdir()
        if path.suffix in (".svg", ".png", ".jpg", ".webp")
    }
    assert len(entries) == len(pictures) >= 12 and {name for _, name, _, _ in entries} == pictures
    for alt, name, _, words in entries:
        said = (MANUAL / "figures" / name).with_suffix(".txt").read_text(encoding="utf-8").strip()
        assert " ".join(words.split()) == said and said.startswith(alt.rstrip("."))


def test_commands_of_the_gallery_are_there(capsys):
    """The script exists; the name is one that it takes, by its own help."""
    for _, name, command, _ in ENTRY.findall(GALLERY):
        python, program, *names = command.split()
        assert python == ".venv/bin/python" and (ROOT / program).is_file(), name
        if names:
            assert names == [name.split(".")[0]]
            try:
                script("figures/make_figures.py").main(["--help"])
            except SystemExit as end:
                assert end.code == 0
            assert re.search(rf"\b{names[0]}\b", capsys.readouterr().out)
