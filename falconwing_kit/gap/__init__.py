"""gap: where model and measurement disagree, which effect is missing, and the gap closed with it.

    Study(baseline=table, flight=table).report()

or step by step: identify_baseline -> name_effect (or name_with_onset) -> close_gap, residual_map
and next_flight.

build_monitor -> Watch does it row by row, along a live or replayed flight.
"""

from falconwing_kit.gap.advice import advise, next_flight
from falconwing_kit.gap.baseline import NominalModel, build_nominal_model, identify_baseline
from falconwing_kit.gap.close import (
    GapClosure,
    Onset,
    ParameterEstimate,
    close_gap,
    find_course,
    find_onset,
    name_with_onset,
)
from falconwing_kit.gap.discrepancy import (
    Discrepancy,
    DiscrepancyTerm,
    discrepancy_record,
    find_discrepancy,
)
from falconwing_kit.gap.innovations import Row, table_rows
from falconwing_kit.gap.measure import (
    FlightReplay,
    ResidualBin,
    replay_baseline,
    replay_flight,
    residual_map,
)
from falconwing_kit.gap.name import EffectCandidate, Naming, name_effect
from falconwing_kit.gap.noise import PoseNoiseModel, find_pose_noise
from falconwing_kit.gap.study import GapStudy, Study, gap_record, require_pair, study_gap
from falconwing_kit.gap.watch import (
    Monitor,
    Watch,
    WatchEvent,
    build_monitor,
    nominal_model_from_file,
    rows_table,
    stream_rows,
    watch_rows,
)

__all__ = [
    "Discrepancy",
    "DiscrepancyTerm",
    "EffectCandidate",
    "FlightReplay",
    "GapClosure",
    "GapStudy",
    "Monitor",
    "Naming",
    "NominalModel",
    "Onset",
    "ParameterEstimate",
    "PoseNoiseModel",
    "ResidualBin",
    "Row",
    "Study",
    "Watch",
    "WatchEvent",
    "advise",
    "build_monitor",
    "build_nominal_model",
    "close_gap",
    "discrepancy_record",
    "find_course",
    "find_discrepancy",
    "find_onset",
    "find_pose_noise",
    "gap_record",
    "identify_baseline",
    "name_effect",
    "name_with_onset",
    "next_flight",
    "nominal_model_from_file",
    "replay_baseline",
    "replay_flight",
    "require_pair",
    "residual_map",
    "rows_table",
    "stream_rows",
    "study_gap",
    "table_rows",
    "watch_rows",
]
