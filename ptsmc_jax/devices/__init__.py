"""Devices between the flight computer and the body: star tracker, gyro, attitude filter, actuators, wheels."""
