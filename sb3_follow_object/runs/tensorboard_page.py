"""Curves in TensorBoard grouped and named in words; the tags stay what they are."""

from __future__ import annotations

from typing import Any

_NAMES: dict[str, dict[str, list[str]]] = {
    "1. Does it learn?": {
        "Success on original goals, noise-free": ["eval/success_rate"],
        "k_max, the highest level of imagined goals in play": ["curriculum/k_max"],
        "Success at level k_max, noise-free: the level rises with it": ["curriculum/test_success"],
    },
    "2. What does it learn from?": {
        "Share of the replay buffer from episodes that moved the object": ["train/moved_share"],
        "Mean reward of what was learned from, relabelled": ["train/reward_mean"],
        "Reaching: successes with the reach policy, and by itself": [
            "reach/success",
            "reach/own_success",
        ],
        "Share of episodes that begin with reaching": ["reach/share"],
    },
    "3. Are the networks sound?": {
        "Mean Q of the actor's actions: minus the steps to go, discounted": ["train/q_mean"],
        "Loss of the critic": ["train/critic_loss"],
        "Loss of the actor": ["train/actor_loss"],
    },
}
_TEXT = """
| question | curve | what tells |
|---|---|---|
| does it learn? | `eval/success_rate` | rises only once `curriculum/k_max` is high |
| does it get harder? | `curriculum/k_max` | stands while `curriculum/test_success` stays low |
| does it touch the object? | `train/moved_share` | near 0: it does not; see *Reaching first* |
| are the networks sound? | `train/q_mean` | leaves [-1 / (1 - gamma), 0]: they are not |

The steps below all curves are env steps of all stages.
**Custom Scalars** has the curves grouped and named.
"""


def describe_curves(writer: Any) -> None:
    """Write into TensorBoard's log how its curves belong together and what they mean.

    Args:
        writer: PyTorch's SummaryWriter.
    """
    layout = {
        group: {name: ["Multiline", tags] for name, tags in charts.items()}
        for group, charts in _NAMES.items()
    }
    writer.add_custom_scalars(layout)
    writer.add_text("how to read these curves", _TEXT)
