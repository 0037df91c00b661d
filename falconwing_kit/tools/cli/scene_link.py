"""falconwing scene link: photos through an analog video link and without it -> the link's model."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from falconwing_kit.tools.cli.show import next_line, print_json, print_table

FITTED = ("snr_db", "dropouts", "dropout_lines", "luma_hz", "chroma_hz", "chroma_noise", "noise_s")


@dataclass(frozen=True)
class Link:
    """Measure an analog video link on photos that came through it, against photos of the same place
    without it.
    """

    through: Annotated[Path, tyro.conf.Positional]
    """folder of photos that came through the link"""
    clean: Annotated[Path, tyro.conf.Positional]
    """folder of photos of the same place without it"""
    json: bool = False
    """print the link as JSON"""

    def run(self) -> int:
        """Fit the link to all photos and, as a measure of scatter, to either half of them.

        Returns:
            0: the link is printed.

        Raises:
            InputError: a folder has fewer than two photos, or their sizes differ.
        """
        from falconwing_kit.tools.capture.survey.link import (
            image_statistics,
            measure_link,
            read_photos,
            subsample,
            transmit,
        )

        through, clean = read_photos(self.through), subsample(read_photos(self.clean))
        link, even, odd = (
            measure_link(photos, clean) for photos in (through, through[::2], through[1::2])
        )
        if self.json:
            print_json({name: asdict(link)[name] for name in FITTED})
            return 0
        rows = [[name, *(getattr(fit, name) for fit in (link, even, odd))] for name in FITTED]
        print_table(("quantity", "all photos", "even ones", "odd ones"), rows)
        print()
        sets = {"through the link": through, "clean": clean}
        sets["clean through the model"] = transmit(link, clean)
        found = {title: image_statistics(images) for title, images in sets.items()}
        rows = [[title, s.luma_noise, s.correlation, s.chroma_noise] for title, s in found.items()]
        print_table(("photos", "luma noise", "correlation", "chroma noise"), rows)
        for title, statistics in found.items():
            print(f"\n{title}, ln of the amplitude by frequency band")
            print("luma", statistics.luma.round(2), "chroma", statistics.chroma.round(2))
        next_line("put the column 'all photos' into a link's table, as in scene/analog.toml")
        return 0
