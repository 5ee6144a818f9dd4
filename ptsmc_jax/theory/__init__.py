"""Analysis without trials: exact solutions, envelopes, design rules, stability margins and the lower error bound."""
