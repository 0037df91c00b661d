"""`falconwing scene edit`: a scene and what to change of it, step by step -> a new scene file."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from falconwing_kit.core.checks import Array, InputError, require_range
from falconwing_kit.core.files import require_writable_path
from falconwing_kit.core.frames import pose_matrix, rotation_world_body
from falconwing_kit.scene import GaussianScene
from falconwing_kit.scene import edit as edits
from falconwing_kit.scene.native import write_quantised
from falconwing_kit.tools.cli.scene import open_scene, scene_record
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

LEADER, PLACED = (
    "leader",
    "aircraft",
)  # an aircraft in its body axes, and what it is called once it stands in a hall
LEVEL = rotation_world_body(
    0.0, 0.0, 0.0
)  # body axes of an aircraft that stands level, nose along x, in the world
Mask = edits.Mask
Rows = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class EditStep:
    """What to edit, and what to do with it: scaled, turned and shifted about its own middle, then
    relit.

    An aircraft labelled "leader" lies in its body axes and waits for `fly` and `render --leader`.
    Resized, relit or with noise it stays so. Moved or renamed it becomes a part of the hall: it
    stands level, nose along x, where its centre of gravity is shifted to, and is called "aircraft"
    unless --name says otherwise.
    """

    add: str = ""
    """a scene to add: a file, or the name of one that ships, such as leader"""
    name: str = ""
    """a new label, for what is added or duplicated or chosen"""
    label: str = ""
    """edit what has this label; what is added is chosen without it"""
    box: str = ""
    """edit what lies in this box: x,y,z of its low and x,y,z of its high corner, in metres"""
    duplicate: bool = False
    """leave it where it is and edit a copy"""
    scale: float = 1.0
    """times its size"""
    rotate_deg: str = ""
    """roll,pitch,yaw in degrees: right wing down, nose up, nose right"""
    translate: str = ""
    """x,y,z in metres"""
    about: str = ""
    """x,y,z that stays when it is scaled and turned; its middle without, and the leader's centre of
    gravity
    """
    brightness: float = 1.0
    """times the light on it"""
    gain: str = ""
    """red,green,blue: times the light of each colour"""
    salt_pepper: float = 0.0
    """share of its Gaussians to turn white or black, 0 to 1"""
    randomise: bool = False
    """draw its size, light and noise as the paper's domain randomisation does"""
    seed: int = 0
    """of whatever is drawn"""
    delete: bool = False
    """take it out"""

    def apply(self, scene: GaussianScene) -> tuple[GaussianScene, Rows]:
        """The scene after this step, and what was done.

        Raises:
            FileNotFoundError: there is no file to add.
            InputError: the step chooses nothing, does nothing, or one of its numbers is wrong.
        """
        self._refuse_what_makes_no_sense()
        if self.delete:
            mask = edits.select_gaussians(scene, self.label, *self._corners())
            record = {
                "gaussians": int(mask.sum()),
                "labels": _labels_of(scene, mask),
                "did": ["delete"],
            }
            return edits.delete(scene, mask), record
        scene, mask, place = self._chosen(scene)
        scene, moved = self._moved(scene, mask, place)
        scene, look = self._dressed(scene, mask, place)
        first = (
            ["add"] * bool(self.add) + ["duplicate"] * self.duplicate + ["rename"] * bool(self.name)
        )
        means = scene.means[mask]
        return scene, {
            "gaussians": int(mask.sum()),
            "labels": _labels_of(scene, mask),
            "did": [*first, *moved, *look],
            **look,
            "low_m": means.min(axis=0).tolist(),
            "high_m": means.max(axis=0).tolist(),
        }

    def _corners(self) -> tuple[Array | None, Array | None]:
        """Low and high corner (3,) of the box [m], or none."""
        if not self.box:
            return None, None
        corners = _numbers("--box", self.box, 6)
        return corners[:3], corners[3:]

    def _refuse_what_makes_no_sense(self) -> None:
        """Refuse a step that chooses or does nothing, or both deletes and changes."""
        changes = [
            self.duplicate, self.scale != 1.0, self.rotate_deg, self.translate, self.brightness != 1.0, self.gain,
            self.salt_pepper, self.randomise, self.add, self.name,
        ]  # fmt: skip
        if not (self.add or self.label or self.box):
            raise InputError(
                "--label: expected --add, --label or --box to say what to edit, got none of them"
            )
        if not (self.delete or any(changes)):
            raise InputError(
                "--translate: expected something to do, such as --translate, --scale or --delete, got nothing"
            )
        if self.delete and any(changes):
            raise InputError(
                "--delete: expected nothing else in the same step, got more; what goes needs no other edit"
            )
        if self.add and self.duplicate:
            raise InputError(
                "--duplicate: expected it without --add, got both; duplicate in a step of its own, by --then"
            )

    def _chosen(self, scene: GaussianScene) -> tuple[GaussianScene, Mask, Array]:
        """The scene with the part to edit under its name, which Gaussians that is, and its middle
        (3,) [m].
        """
        part = open_scene(self.add) if self.add else scene
        label = (
            "" if self.add and self.label == self.name else self.label
        )  # what is added takes its name at once
        mask = edits.select_gaussians(part, label, *self._corners())
        if self.duplicate:
            part, mask = part.selected(mask), np.ones(mask.sum(), bool)
        waits, name = _labels_of(part, mask) == [LEADER], self.name
        place = np.zeros(3) if waits else edits.centre_of(part, mask)
        if waits and (
            self.rotate_deg or self.translate or self.duplicate or name not in ("", LEADER)
        ):
            if name == LEADER:
                raise InputError(
                    "--name leader: expected another name, as that is for an aircraft that waits to be placed"
                )
            part, name = (
                edits.move(part, mask, pose_matrix(LEVEL, np.zeros(3))),
                name or _free_name(scene),
            )
        place = _numbers("--about", self.about, 3) if self.about else place
        if not (self.add or self.duplicate):
            return (edits.rename(part, mask, name) if name else part), mask, place
        joined = (
            edits.add(scene, part, name) if self.add or name else GaussianScene.joined(scene, part)
        )
        return joined, np.concatenate([np.zeros(len(scene), bool), mask]), place

    def _moved(
        self, scene: GaussianScene, mask: Mask, place: Array
    ) -> tuple[GaussianScene, list[str]]:
        """The part scaled, turned and shifted, and which of it was done."""
        did = []
        if self.scale != 1.0:
            scene, did = edits.scale(scene, mask, self.scale, place), ["scale"]
        if self.rotate_deg:
            angles = np.radians(_numbers("--rotate-deg", self.rotate_deg, 3))
            # From level to the attitude, both seen in the world: zero angles turn nothing.
            scene = edits.rotate(scene, mask, rotation_world_body(*angles) @ LEVEL.T, place)
            did.append("rotate")
        if self.translate:
            scene = edits.translate(scene, mask, _numbers("--translate", self.translate, 3))
            did.append("translate")
        return scene, did

    def _dressed(
        self, scene: GaussianScene, mask: Mask, place: Array
    ) -> tuple[GaussianScene, Rows]:
        """The part in its new look, and the look."""
        look: Rows = {}
        if self.randomise:
            drawn = edits.draw_appearance(self.seed)
            shift = _numbers("--translate", self.translate, 3) if self.translate else np.zeros(3)
            scene = edits.apply_appearance(scene, mask, drawn, place + shift)
            look["randomise"] = {
                "scale": drawn.scale,
                "brightness": drawn.brightness,
                "salt_pepper": drawn.salt_pepper,
            }
        if self.brightness != 1.0 or self.gain:
            gain = _numbers("--gain", self.gain, 3) if self.gain else np.ones(3)
            scene = edits.relight(
                scene, mask, require_range("--brightness", self.brightness, low=0.0), gain
            )
            look["relight"] = {"brightness": self.brightness, "gain": gain.tolist()}
        if self.salt_pepper:
            scene = edits.salt_and_pepper(scene, mask, self.salt_pepper, self.seed)
            look["salt_pepper"] = {"share": self.salt_pepper}
        return scene, look


@dataclass(frozen=True, kw_only=True)
class Edit(EditStep):
    """Edit a scene: add, duplicate, resize, turn, shift, relight or delete parts of it, and write
    the result.

    An aircraft above the runway, and the pad in half the light:

        falconwing scene edit arena --label leader --translate=-6,-2,1.5 --rotate-deg 20,0,10
            --then "label=pad brightness=0.5" --out edited.npz
    """

    scene: Annotated[str, tyro.conf.Positional]
    """a file, or the name of a scene that ships"""
    out: Path
    """the file to write: .npz, which keeps labels, or .ply"""
    then: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """one more step after this: its options without dashes, in quotes; may be given again and again
    """
    small: bool = False
    """write an .npz in whole numbers of few bits, as `scene fit` does: a quarter of the size"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Edit, write and say what changed.

        Returns:
            0: the edited scene is written.

        Raises:
            FileNotFoundError: there is no scene, or no folder for the new one.
            InputError: a step makes no sense, or a file cannot be read or written.
        """
        if require_writable_path(self.out).suffix.lower() not in (".npz", ".ply"):
            raise InputError(
                f"{self.out}: expected a name ending in .npz or .ply for a scene, got another ending"
            )
        if self.small and self.out.suffix.lower() != ".npz":
            raise InputError(
                f"--small: expected --out to end in .npz, which can be small, got {self.out.name}"
            )
        steps: list[EditStep] = [self, *(parse_step(words) for words in self.then)]
        scene, records = open_scene(self.scene), []
        before = len(scene)
        for step in steps:
            scene, record = step.apply(scene)
            records.append(record)
        write_quantised(self.out, scene) if self.small else scene.save(self.out)
        self._say(
            {
                "file": str(self.out),
                "before": before,
                "steps": records,
                "scene": scene_record(scene),
            }
        )
        return 0

    def _say(self, record: Rows) -> None:
        """Print what changed."""
        if self.json:
            print_json(record)
            return
        rows = [
            (", ".join(step["labels"]), step["gaussians"], ", ".join(step["did"]))
            for step in record["steps"]
        ]
        counts = f"{record['before']} Gaussians before, {record['scene']['gaussians']} now"
        print_table(("part", "Gaussians", "what was done"), rows, title=f"{self.out}: {counts}")
        next_line(f"falconwing render {self.out} --pose=-10,-2,1.5,0,-3,0 --out view.png")


def parse_step(words: str) -> EditStep:
    """One step from its options in one text, such as "label=pad brightness=0.5" or "label=wall
    delete".

    Raises:
        InputError: the quotes in it are not closed.
        SystemExit: 2, where an option is not known.
    """
    try:
        options = [f"--{word}" for word in shlex.split(words)]
    except ValueError as error:
        raise InputError(
            f"--then: expected options such as label=pad brightness=0.5, got {words[:80]!r} ({error})"
        ) from None
    return tyro.cli(
        EditStep,
        prog="falconwing scene edit --then",
        args=options,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _labels_of(scene: GaussianScene, mask: Mask) -> list[str]:
    """The labels that occur in a part."""
    return [scene.label_names[number] for number in np.unique(scene.labels[mask])]


def _free_name(scene: GaussianScene) -> str:
    """A name for one more aircraft in the hall."""
    names = [PLACED, *(f"{PLACED} {number}" for number in range(2, 257))]
    return next(name for name in names if name not in scene.label_names)


def _numbers(option: str, text: str, count: int) -> Array:
    """So many finite numbers from a text such as "1,2,3".

    Raises:
        InputError: they are others.
    """
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(
            f"{option}: expected {count} numbers with commas between them, got {text[:80]!r}"
        )
    return values
