"""Export of the flight software of the sampled loop as C99, with test vectors that check the C."""
