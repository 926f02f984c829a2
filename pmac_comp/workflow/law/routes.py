"""What the routes differ in, beside the tables and programs that they upload."""

TORQUE_ROUTES = ("law", "servo")  # the law at servo rate, with torque feed-forward
MOTION_ROUTES = ("cam", "program")  # for one known motion
# Servo cycles from the evaluation of the law to the servo that uses it.
LATENCY_CYCLES = {"law": 1, "servo": 0, "table": 0, "cam": 0, "program": 0}
