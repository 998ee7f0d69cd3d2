"""The plant: dynamics, sensor, actuator; the inputs and the controller."""
