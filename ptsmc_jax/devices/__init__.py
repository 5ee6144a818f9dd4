"""Hardware and filters between the control law and the body: sensors, attitude filters, actuators, wheels."""
