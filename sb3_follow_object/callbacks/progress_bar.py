"""SB3's progress bar, for trainings in which env steps are not those of the rollouts alone."""

from __future__ import annotations

from stable_baselines3.common.callbacks import ProgressBarCallback


class WholeProgressBar(ProgressBarCallback):
    """Counts the model's env steps, so that the curriculum's tests are among them."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._begun_at = self.model.num_timesteps

    def _on_step(self) -> bool:
        self.pbar.update(self.model.num_timesteps - self._begun_at - self.pbar.n)
        return True

    def _on_training_end(self) -> None:
        self._on_step()  # tests after the last rollout
        super()._on_training_end()
