"""What theory says of a run: exact solutions, envelopes, rules, the linearised loop, margins, the floor."""
