"""The car as a chain of effects: command, actuator, body, sensor."""
