"""What the loop is given: reference attitudes and disturbance torques."""
