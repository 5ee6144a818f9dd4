"""Control laws: the paper's for every kind of plant, and those to compare with."""
