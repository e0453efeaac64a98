"""TensorBoard shows curves grouped and named; the tags are those that are logged."""

from __future__ import annotations

from pathlib import Path

import tiny_runs
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2

from sb3_follow_object.runs import tensorboard_page


def test_layout_names_what_a_run_logs(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    tiny_runs.run(folder)
    log = EventAccumulator(str(folder)).Reload()
    logged = set(log.Tags()["scalars"])
    assert {"eval/success_rate", "curriculum/k_max", "train/q_mean"} <= logged
    content = log.Tensors("custom_scalars__config__")[0].tensor_proto.string_val[0]
    layout = layout_pb2.Layout()
    layout.ParseFromString(content)
    charts = {c.title: list(c.multiline.tag) for group in layout.category for c in group.chart}
    assert charts["Success on original goals, noise-free"] == ["eval/success_rate"]
    named = {tag for tags in charts.values() for tag in tags}
    assert named - logged <= {"reach/success", "reach/own_success", "reach/share"}


def test_page_asks_before_it_answers() -> None:
    for tag in ("eval/success_rate", "curriculum/test_success", "train/moved_share"):
        assert tag in tensorboard_page._TEXT
