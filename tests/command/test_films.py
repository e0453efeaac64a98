"""Moving pictures: the method in three panels, and the film in TensorBoard's log."""

from __future__ import annotations

import io
from pathlib import Path

import arm_and_wall
import numpy as np
import pytest
import toy
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_follow_object.command import demo, films, pictures
from sb3_follow_object.command.cli import main
from sb3_follow_object.runs.run_folder import claim
from sb3_follow_object.settings.presets import run_config

TASK = "FollowObject/PnPShelf-v0"


def test_gif_keeps_frames_times_and_the_colours_of_small_things() -> None:
    frames = [np.full((40, 60, 3), 230, np.uint8) for _ in range(4)]
    for number, frame in enumerate(frames):
        frame[:, :, 2] = np.linspace(200, 250, 60)  # a background of many colours
        frame[10:13, 10 * number : 10 * number + 3] = (240, 20, 20)
    film = Image.open(io.BytesIO(films.gif(frames, 40, 1500)))
    assert (film.n_frames, film.info["loop"], film.info["duration"]) == (4, 0, 40)
    film.seek(3)
    assert film.info["duration"] == 1500
    seen = np.asarray(film.convert("RGB"))[11, 31].astype(int)
    assert np.abs(seen - (240, 20, 20)).max() < 30


@pytest.mark.usefixtures("can_draw")
def test_story_shows_object_goals_and_robot(tmp_path: Path) -> None:
    out = tmp_path / "story.gif"
    predictor = toy.StraightPredictor()
    predictor.horizon = 50
    films.draw_story(demo.demo_policy("PnPShelf"), predictor, TASK, out)
    film = Image.open(out)
    assert film.size == (900, 300)
    assert out.stat().st_size < 3_000_000
    frames = []
    for each in (0, film.n_frames - 1):
        film.seek(each)
        frames.append(np.asarray(film.convert("RGB")).astype(int))
    for panel in range(3):  # something has changed in each
        parts = [frame[60:, 300 * panel : 300 * (panel + 1)] for frame in frames]
        assert (np.abs(parts[0] - parts[1]).max(axis=-1) > 60).sum() > 50


def test_story_of_a_robot_that_never_succeeds_is_refused_before_anything_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = []

    def miss(actor: object, env: object, n_episodes: int, seed: int, each_step: object) -> float:
        seeds.append(seed)
        return 0.0

    monkeypatch.setattr(films, "play", miss)
    monkeypatch.setattr(films, "frame", lambda env: pytest.fail("it was drawn"))
    policy, out = demo.demo_policy("PnPShelf"), tmp_path / "story.gif"
    with pytest.raises(RuntimeError, match="does not succeed in 20 episodes"):
        films.draw_story(policy, toy.StraightPredictor(), TASK, out, seed=100)
    assert seeds == list(range(100, 120))
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("can_draw")
def test_film_is_in_the_log_at_the_runs_last_step(tmp_path: Path) -> None:
    (tmp_path / "policy.safetensors").write_bytes(demo.demo_policy("PnPShelf").read_bytes())
    (tmp_path / "evaluations.csv").write_text("env_steps,success_rate\n1234,1.0\n")
    films.add_film(tmp_path, TASK)
    log = EventAccumulator(str(tmp_path)).Reload()
    (film,) = log.Images("film/last_policy_on_original_goals")
    assert film.step == 1234
    assert (film.width, film.height) == (480, 480)
    assert Image.open(io.BytesIO(film.encoded_image_string)).n_frames == 51


@pytest.mark.usefixtures("can_draw")
def test_imagined_goals_go_from_violet_to_yellow_in_environments_of_others_too(
    tmp_path: Path,
) -> None:
    predictor = toy.StraightPredictor()
    predictor.horizon = 50
    pictures.draw_imagined(arm_and_wall.ARM, predictor, tmp_path / "imagined.png")
    image = np.asarray(Image.open(tmp_path / "imagined.png").convert("RGB")).astype(int)
    assert image.shape == (480, 3 * 480, 3)
    red, green, blue = (image[..., channel] for channel in range(3))
    assert ((red > 2 * blue) & (green > 2 * blue) & (red > 60)).sum() > 50, "the last levels"
    assert ((red > 2 * green) & (blue > 2 * green) & (blue > 20)).sum() > 10, "the first"


@pytest.mark.usefixtures("can_draw")
def test_all_tasks_are_drawn_side_by_side(tmp_path: Path) -> None:
    assert main(["picture", "tasks", "--out", str(tmp_path / "tasks.png")]) == 0
    assert Image.open(tmp_path / "tasks.png").size == (4 * 480, 2 * 480)


@pytest.mark.usefixtures("can_draw")
def test_a_task_of_ones_own_is_drawn_alone(tmp_path: Path) -> None:
    out = tmp_path / "task.png"
    words = ["--env", "own_tasks:FollowObject/PushPast-v0", "--out", str(out)]
    assert main(["picture", "tasks", *words]) == 0
    drawn = np.asarray(Image.open(out)).astype(int)
    assert drawn.shape == (480, 480, 3)
    red, _, blue = np.moveaxis(drawn, 2, 0)
    assert (red > 2 * blue).sum() > 100 < (blue > 2 * red).sum(), "the regions are there"


@pytest.mark.parametrize(
    "words, sentence",
    [
        (["tasks", "RUN"], "picture tasks takes no RUN"),
        (["tasks", "--env", "FollowObject/PnPShlf-v0"], "did you mean 'FollowObject/PnPShelf-v0'"),
        (["story", "RUN", "--env", TASK], "picture story takes no --env; a RUN says which task"),
        (["story"], "picture story needs the folder of a RUN"),
        (["story", "RUN", "--out", "story.png"], "story.png does not end in .gif"),
        (["imagined", "RUN", "--seed", "-1"], "seed is -1; it must be at least 0"),
        (["story", "RUN"], "of a predictor: No such file or directory"),
    ],
)
def test_what_cannot_be_drawn_is_refused_in_a_sentence(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    claim(tmp_path / "run", run_config(TASK))
    words = [str(tmp_path / "run") if word == "RUN" else word for word in words]
    assert main(["picture", *words]) == 2
    assert sentence in capsys.readouterr().err
