"""What may have been meant: near names alone."""

from __future__ import annotations

import pytest

from sb3_follow_object.common.suggestions import did_you_mean

OF_AN_ENVIRONMENT = ("env_id", "make_env", "object", "goal", "is_success", "effector")


@pytest.mark.parametrize(
    ("word", "known", "said"),
    [
        ("device", OF_AN_ENVIRONMENT, "; known are env_id, make_env, object, goal, is_success, e"),
        ("normalize", ("noise_std", "tau"), "; known are noise_std, tau"),
        ("objet", OF_AN_ENVIRONMENT, "; did you mean 'object'?"),
        ("steps", ("n_timesteps", "tau"), "; did you mean 'n_timesteps'?"),
        ("PnPShelv", ("FollowObject/PnPShelf-v0",), "; did you mean 'FollowObject/PnPShelf-v0'?"),
        ("?", map(str, range(100)), "57, 58, 59 and 40 more"),
    ],
)
def test_names_that_have_little_in_common_are_not_suggested(
    word: str, known: tuple[str, ...], said: str
) -> None:
    assert said in did_you_mean(word, known)
