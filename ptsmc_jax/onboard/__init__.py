"""To flight: what the flight computer of the sampled loop does, written as C99, with vectors that check it."""
