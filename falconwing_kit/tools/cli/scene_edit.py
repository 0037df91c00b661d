"""falconwing scene edit: a scene and the changes of its parts, step by step -> a new scene file."""

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
from falconwing_kit.tools.cli.scene_input import open_scene, scene_record
from falconwing_kit.tools.cli.show import next_line, print_json, print_table

# labels: an aircraft in body axes, and an aircraft placed in a hall
LEADER, PLACED = "leader", "aircraft"
R_WORLD_LEVEL = rotation_world_body(0.0, 0.0, 0.0)  # an aircraft placed level, nose along x
Mask = edits.Mask
Rows = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class EditStep:
    """One step: select a part, scale, rotate and translate it about its centre, then relight it.

    An aircraft labelled "leader" is stored in body axes, for `fly` and `render --leader`. Scaling,
    relighting and noise keep it so. Moving or renaming it places it in the hall: level, nose along
    x, its centre of gravity at --translate, labelled "aircraft" or --name.
    """

    add: str = ""
    """a scene to add: a file, or the name of a shipped one, such as leader"""
    name: str = ""
    """a new label for the part"""
    label: str = ""
    """select by label; an added scene is selected without it"""
    box: str = ""
    """select by box: x,y,z of its low and x,y,z of its high corner, in metres"""
    duplicate: bool = False
    """keep the part and edit a copy"""
    scale: float = 1.0
    """factor of its size"""
    rotate_deg: str = ""
    """roll,pitch,yaw in degrees: positive right wing down, nose up, nose right"""
    translate: str = ""
    """x,y,z in metres"""
    about: str = ""
    """fixed point x,y,z of scaling and rotation; its centre if not given, for a leader its centre
    of gravity
    """
    brightness: float = 1.0
    """factor of its brightness"""
    gain: str = ""
    """red,green,blue: factor of each colour"""
    salt_pepper: float = 0.0
    """share of its Gaussians set to white or black, 0 to 1"""
    randomise: bool = False
    """draw size, brightness and noise as in the paper's domain randomisation"""
    seed: int = 0
    """of the random draws"""
    delete: bool = False
    """delete the part"""

    def apply(self, scene: GaussianScene) -> tuple[GaussianScene, Rows]:
        """The scene after this step, and a record of it.

        Raises:
            FileNotFoundError: there is no file to add.
            InputError: the step selects nothing, changes nothing, or a number is invalid.
        """
        self._require_valid()
        if self.delete:
            mask = edits.select_gaussians(scene, self.label, *self._corners())
            record = {
                "gaussians": int(mask.sum()),
                "labels": _labels_of(scene, mask),
                "did": ["delete"],
            }
            return edits.delete(scene, mask), record
        scene, mask, centre = self._select(scene)
        scene, moves = self._transform(scene, mask, centre)
        scene, changes = self._relight(scene, mask, centre)
        first = (
            ["add"] * bool(self.add) + ["duplicate"] * self.duplicate + ["rename"] * bool(self.name)
        )
        means = scene.means[mask]
        return scene, {
            "gaussians": int(mask.sum()),
            "labels": _labels_of(scene, mask),
            "did": [*first, *moves, *changes],
            **changes,
            "low_m": means.min(axis=0).tolist(),
            "high_m": means.max(axis=0).tolist(),
        }

    def _corners(self) -> tuple[Array | None, Array | None]:
        """Low and high corner (3,) of the box [m], or none."""
        if not self.box:
            return None, None
        corners = _numbers("--box", self.box, 6)
        return corners[:3], corners[3:]

    def _require_valid(self) -> None:
        """Raise InputError for a step without selection or change, or --delete with a change."""
        changes = [
            *(self.duplicate, self.add, self.name),
            *(self.scale != 1.0, self.rotate_deg, self.translate),
            *(self.brightness != 1.0, self.gain, self.salt_pepper, self.randomise),
        ]
        if not (self.add or self.label or self.box):
            raise InputError(
                "--label: expected a selection by --add, --label or --box, got none of them"
            )
        if not (self.delete or any(changes)):
            raise InputError(
                "--translate: expected a change such as --translate, --scale or --delete, got none"
            )
        if self.delete and any(changes):
            raise InputError(
                "--delete: expected no other change in the same step, got one; leave it out"
            )
        if self.add and self.duplicate:
            raise InputError(
                "--duplicate: expected it without --add, got both; add a second step by --then"
            )

    def _select(self, scene: GaussianScene) -> tuple[GaussianScene, Mask, Array]:
        """The scene with the part under its name, the part's mask and its centre (3,) [m]."""
        part = open_scene(self.add) if self.add else scene
        # an added scene gets its name first, so this label selects all of it
        label = "" if self.add and self.label == self.name else self.label
        mask = edits.select_gaussians(part, label, *self._corners())
        if self.duplicate:
            part, mask = part.selected(mask), np.ones(mask.sum(), bool)
        in_body_axes, name = _labels_of(part, mask) == [LEADER], self.name
        centre = np.zeros(3) if in_body_axes else edits.centre_of(part, mask)
        if in_body_axes and (
            self.rotate_deg or self.translate or self.duplicate or name not in ("", LEADER)
        ):
            if name == LEADER:
                raise InputError(
                    "--name leader: expected another name, this one is for an aircraft in body axes"
                )
            part, name = (
                edits.move(part, mask, pose_matrix(R_WORLD_LEVEL, np.zeros(3))),
                name or _free_name(scene),
            )
        centre = _numbers("--about", self.about, 3) if self.about else centre
        if not (self.add or self.duplicate):
            return (edits.rename(part, mask, name) if name else part), mask, centre
        joined = (
            edits.add(scene, part, name) if self.add or name else GaussianScene.joined(scene, part)
        )
        return joined, np.concatenate([np.zeros(len(scene), bool), mask]), centre

    def _transform(
        self, scene: GaussianScene, mask: Mask, centre: Array
    ) -> tuple[GaussianScene, list[str]]:
        """Scale, rotate and translate the part; also the names of what was done."""
        did = []
        if self.scale != 1.0:
            scene, did = edits.scale(scene, mask, self.scale, centre), ["scale"]
        if self.rotate_deg:
            angles = np.radians(_numbers("--rotate-deg", self.rotate_deg, 3))
            # from level to the attitude, in the world frame: zero angles are the identity
            scene = edits.rotate(
                scene, mask, rotation_world_body(*angles) @ R_WORLD_LEVEL.T, centre
            )
            did.append("rotate")
        if self.translate:
            scene = edits.translate(scene, mask, _numbers("--translate", self.translate, 3))
            did.append("translate")
        return scene, did

    def _relight(
        self, scene: GaussianScene, mask: Mask, centre: Array
    ) -> tuple[GaussianScene, Rows]:
        """Change the part's light, noise and drawn appearance; also a record of the changes."""
        changes: Rows = {}
        if self.randomise:
            drawn = edits.draw_appearance(self.seed)
            shift = _numbers("--translate", self.translate, 3) if self.translate else np.zeros(3)
            scene = edits.apply_appearance(scene, mask, drawn, centre + shift)
            changes["randomise"] = {
                "scale": drawn.scale,
                "brightness": drawn.brightness,
                "salt_pepper": drawn.salt_pepper,
            }
        if self.brightness != 1.0 or self.gain:
            gain = _numbers("--gain", self.gain, 3) if self.gain else np.ones(3)
            scene = edits.relight(
                scene, mask, require_range("--brightness", self.brightness, low=0.0), gain
            )
            changes["relight"] = {"brightness": self.brightness, "gain": gain.tolist()}
        if self.salt_pepper:
            scene = edits.salt_and_pepper(scene, mask, self.salt_pepper, self.seed)
            changes["salt_pepper"] = {"share": self.salt_pepper}
        return scene, changes


@dataclass(frozen=True, kw_only=True)
class Edit(EditStep):
    """Edit a scene: add, duplicate, scale, rotate, translate, relight or delete parts of it.

    Example: an aircraft above the runway, and the pad at half the brightness:

        falconwing scene edit arena --label leader --translate=-6,-2,1.5 --rotate-deg 20,0,10
            --then "label=pad brightness=0.5" --out edited.npz
    """

    scene: Annotated[str, tyro.conf.Positional]
    """a file, or the name of a shipped scene"""
    out: Path
    """the file to write: .npz (with labels) or .ply"""
    then: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """a further step: its options without dashes, in quotes; may be repeated"""
    small: bool = False
    """write a quantised .npz, as `scene fit` does: a quarter of the size"""
    json: bool = False
    """print the result as JSON"""

    def run(self) -> int:
        """Edit, write and print the changes.

        Returns:
            0: the edited scene is written.

        Raises:
            FileNotFoundError: the scene or the folder of --out is missing.
            InputError: a step is invalid, or a file cannot be read or written.
        """
        if require_writable_path(self.out).suffix.lower() not in (".npz", ".ply"):
            raise InputError(
                f"{self.out}: expected a scene's name ending in .npz or .ply, got another ending"
            )
        if self.small and self.out.suffix.lower() != ".npz":
            raise InputError(f"--small: expected --out to end in .npz, got {self.out.name}")
        steps: list[EditStep] = [self, *(parse_step(words) for words in self.then)]
        scene, records = open_scene(self.scene), []
        before = len(scene)
        for step in steps:
            scene, record = step.apply(scene)
            records.append(record)
        write_quantised(self.out, scene) if self.small else scene.save(self.out)
        after = scene_record(scene)
        self._print({"file": str(self.out), "before": before, "steps": records, "scene": after})
        return 0

    def _print(self, record: Rows) -> None:
        """Print the changes."""
        if self.json:
            print_json(record)
            return
        rows = [
            (", ".join(step["labels"]), step["gaussians"], ", ".join(step["did"]))
            for step in record["steps"]
        ]
        counts = f"{record['before']} Gaussians before, {record['scene']['gaussians']} now"
        print_table(("part", "Gaussians", "changes"), rows, title=f"{self.out}: {counts}")
        next_line(f"falconwing render {self.out} --pose=-10,-2,1.5,0,-3,0 --out view.png")


def parse_step(words: str) -> EditStep:
    """One step from its options as text, such as "label=pad brightness=0.5" or "label=wall delete".

    Raises:
        InputError: a quote is not closed.
        SystemExit: 2 for an unknown option.
    """
    try:
        options = [f"--{word}" for word in shlex.split(words)]
    except ValueError as error:
        raise InputError(
            f"--then: expected options like label=pad brightness=0.5, got {words[:80]!r}: {error}"
        ) from None
    return tyro.cli(
        EditStep,
        prog="falconwing scene edit --then",
        args=options,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _labels_of(scene: GaussianScene, mask: Mask) -> list[str]:
    """The labels of a part."""
    return [scene.label_names[number] for number in np.unique(scene.labels[mask])]


def _free_name(scene: GaussianScene) -> str:
    """An unused label for an aircraft placed in the hall."""
    names = [PLACED, *(f"{PLACED} {number}" for number in range(2, 257))]
    return next(name for name in names if name not in scene.label_names)


def _numbers(option: str, text: str, count: int) -> Array:
    """`count` finite numbers from a text such as "1,2,3", else InputError."""
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(
            f"{option}: expected {count} numbers separated by commas, got {text[:80]!r}"
        )
    return values
