"""What runs beside the autopilot: links, decoding, logs, live loop, decision, recovery, command line."""
