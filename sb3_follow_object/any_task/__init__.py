"""Tasks that nobody here wrote: the object alone of any Gymnasium environment on MuJoCo."""
