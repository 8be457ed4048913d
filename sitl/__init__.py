"""Vehicles to test against: plants, sensors, faults, guidance, and an autopilot that speaks MAVLink."""
