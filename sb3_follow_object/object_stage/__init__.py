"""Stage one: the object learns alone (section 4.1); its paths, and what SLDR reads of it."""
