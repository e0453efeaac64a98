"""Settings of tiny runs, as words of a command line."""

TINY_NETWORKS = ["policy_kwargs.net_arch=[8]", "batch_size=16", "gradient_steps=2"]
TINY_NETWORKS += ["buffer_size=2000"]  # the default of a million takes a second to lay out
TINY_STAGES = ["object_timesteps=800", "n_paths=16", "predictor_fit.epochs=1"]
TINY_STAGES += ["inverse_fit.hidden=[8]", "inverse_fit.updates=10"]
TINY_STAGES += ["predictor_fit.hidden=[8]", "object_algorithm.policy_kwargs.net_arch=[8]"]
TINY_STAGES += ["object_algorithm.batch_size=16", "object_algorithm.gradient_steps=2"]
TINY_STAGES += ["object_algorithm.buffer_size=2000", "reach.n_updates=2", "reach.batch_size=16"]
TINY_TESTS = ["n_test_episodes=2", "eval_every=400", "n_eval_episodes=4", "n_final_episodes=8"]
TINY = [*TINY_NETWORKS, *TINY_STAGES, *TINY_TESTS]
