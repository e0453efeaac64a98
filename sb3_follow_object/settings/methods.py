"""The methods that have presets; kept apart from what needs torch, for the command line's help."""

METHODS = ("fo", "her", "shaped", "rnd", "sldr", "cher", "fo-sldr", "rher")
WITHOUT_PAPER = ("rher",)  # the paper has no such rival, so there is no preset of its settings
