"""All checks: what each needs, its limit and where that comes from, how grave it may be, and its words."""

from collections.abc import Callable
from functools import partial
from typing import Final

from companion.checks import (
    airspeed,
    battery,
    compass,
    estimator,
    gps,
    height,
    inertial,
    link,
    outputs,
    sensors,
    texts,
    timeline,
    tracking,
    vibration,
)
from companion.checks.finding import EVERY_BEAT, EVERY_FRAME, SOURCE_OURS, Check, Severity, Unit
from companion.checks.flight import Flight

INFO, WARNING, FAULT = Severity.INFO, Severity.WARNING, Severity.FAULT
EVERY: Final = (EVERY_FRAME,)
BEATS: Final = (EVERY_BEAT,)
GPS: Final = ("GPS_RAW_INT",)
IMU: Final = "RAW_IMU|SCALED_IMU|HIGHRES_IMU"
IMUS: Final = "RAW_IMU|SCALED_IMU|SCALED_IMU2|SCALED_IMU3|HIGHRES_IMU"
SECOND: Final = "SCALED_IMU2|SCALED_IMU3|HIGHRES_IMU"
ESTIMATOR: Final = ("EKF_STATUS_REPORT|ESTIMATOR_STATUS",)
AIRSPEED: Final = "AIRSPEED|VFR_HUD"

Builder = Callable[[Check, Flight], Unit]

# fmt: off
ROWS: Final[tuple[tuple[Check, Builder], ...]] = (
    (Check("vehicles", BEATS, 0.0, "", "MAVLink heartbeat protocol", INFO, "vehicles in the log"), timeline.Vehicles),
    (Check("arming", ("HEARTBEAT",), 0.0, "", "MAV_MODE_FLAG_SAFETY_ARMED", INFO, "armed"), timeline.Arming),
    (Check("modes", ("HEARTBEAT",), 0.0, "", "HEARTBEAT.custom_mode", INFO, "flight modes"), timeline.Modes),
    (Check("link_loss", EVERY, 5.0, "%", SOURCE_OURS, WARNING,
           "frames of the vehicle are missing by their sequence numbers"), link.Loss),
    (Check("link_silence", EVERY, 5.0, "s", "MAVLink heartbeat protocol: lost after 4 to 5 beats", WARNING,
           "nothing came from the vehicle"), link.Silence),
    (Check("link_flood", EVERY, 500.0, "frame/s", SOURCE_OURS, WARNING,
           "somebody floods the link"), link.Flood),
    (Check("link_identity", BEATS, 1.0, "kind", "MAVLink routing: an id belongs to one component", WARNING,
           "two speak under one id"), link.Identity),
    (Check("failsafe", ("STATUSTEXT",), 0.0, "", "ArduPilot's and PX4's failsafe texts", WARNING,
           "failsafe while armed"), texts.Failsafes),
    (Check("texts_known", ("STATUSTEXT",), 0.0, "", "texts of ArduPilot's libraries and PX4's commander", FAULT,
           "the autopilot says"), texts.KnownTexts),
    (Check("texts_severe", ("STATUSTEXT",), 2.0, "MAV_SEVERITY", "MAV_SEVERITY_CRITICAL", WARNING,
           "critical texts while armed"), texts.SevereTexts),
    (Check("gps_fix", GPS, 2.0, "s", "GPS_FIX_TYPE_3D_FIX, GPS_FIX_TYPE_NO_GPS", FAULT,
           "GPS lost its 3D fix while armed"), gps.Fix),
    (Check("gps_satellites", GPS, 6.0, "", "ArduPilot AHRS_GPS_MINSATS 6, PX4 EKF2_REQ_NSATS 6", WARNING,
           "too few GPS satellites while armed"), gps.satellites),
    (Check("gps_hdop", GPS, 3.0, "", "ArduPilot LogAnalyzer, HDOP warning", WARNING,
           "GPS geometry bad while armed"), gps.hdop),
    (Check("gps_accuracy", GPS, 5.0, "m", "ArduPilot EKF3, horizontal accuracy to align by GPS", WARNING,
           "GPS states a large error while armed"), gps.Accuracy),
    (Check("gps_jump", GPS, 25.0, "m", "ArduPilot EK3_GLITCH_RAD 25 m", FAULT,
           "GPS position jumped beyond its own velocity"), gps.Jump),
    (Check("gps_drift", GPS, 0.25, "m/s", SOURCE_OURS, FAULT,
           "GPS position and GPS velocity contradict each other"), gps.Drift),
    (Check("ekf_variance", ESTIMATOR, 0.8, "", "ArduPilot FS_EKF_THRESH 0.8; ESTIMATOR_STATUS: ratios above 1", WARNING,
           "the estimator distrusts its sensors"), estimator.Variances),
    (Check("ekf_flags", ESTIMATOR, 1.0, "s", "EKF_STATUS_FLAGS, ESTIMATOR_STATUS_FLAGS", WARNING,
           "the estimator withdrew what it knew while armed"), estimator.Flags),
    (Check("vibration", ("VIBRATION",), 30.0, "m/s2", "ArduPilot, measuring vibration", WARNING,
           "vibration is high"), vibration.vibration),
    (Check("clipping", ("VIBRATION",), 100.0, "", "ArduPilot, measuring vibration", WARNING,
           "accelerometers were driven to their limit"), vibration.Clipping),
    (Check("battery_low", ("SYS_STATUS|BATTERY_STATUS",), 15.0, "%", "PX4 BAT_LOW_THR 15 %; MAV_BATTERY_CHARGE_STATE",
           FAULT, "battery low while armed"), battery.Charge),
    (Check("battery_cell", ("SYS_STATUS",), 3.5, "V", "ArduPilot BATT_LOW_VOLT 10.5 V of three cells", WARNING,
           "volts a battery cell are low while armed"), battery.Cells),
    (Check("battery_drop", ("SYS_STATUS",), 0.08, "", SOURCE_OURS, FAULT,
           "battery voltage fell though no more current is drawn"), battery.Drop),
    (Check("power_rail", ("POWER_STATUS",), 4.6, "V", "ArduPilot LogAnalyzer, Vcc", WARNING,
           "the autopilot's supply is weak while armed"), battery.rail),
    (Check("sensor_health", ("SYS_STATUS",), 2.0, "s", "MAV_SYS_STATUS_SENSOR", FAULT,
           "not healthy by the autopilot's own judgement"), sensors.Health),
    (Check("output_saturation", ("SERVO_OUTPUT_RAW",), 10.0, "s", "ArduPilot SERVOn_MIN 1100, SERVOn_MAX 1900", WARNING,
           "outputs stand at their limit", also=("PARAM_VALUE",)), outputs.Saturation),
    (Check("motor_balance", ("SERVO_OUTPUT_RAW",), 75.0, "us", "ArduPilot LogAnalyzer, motor balance", WARNING,
           "motors work unequally"), outputs.MotorBalance),
    (Check("attitude_tracking", ("NAV_CONTROLLER_OUTPUT|ATTITUDE_TARGET", "ATTITUDE"), 15.0, "deg",
           "ArduCopter thrust loss check, 15 deg", WARNING, "attitude does not follow its command"), tracking.Tracking),
    (Check("gyro_pair", (IMU, SECOND), 0.010, "rad/s", SOURCE_OURS, FAULT,
           "gyros drifted apart"), partial(inertial.Pair, quantity=inertial.GYROS)),
    (Check("accelerometer_pair", (IMU, SECOND), 0.30, "m/s2", SOURCE_OURS, FAULT,
           "accelerometers drifted apart"), partial(inertial.Pair, quantity=inertial.ACCELEROMETERS)),
    (Check("imu_frozen", (IMUS, "ATTITUDE"), 5.0, "s", SOURCE_OURS, FAULT,
           "an inertial sensor repeats itself"), inertial.Frozen),
    (Check("gyro_bias", (IMU, "ATTITUDE"), 0.015, "rad/s", SOURCE_OURS, WARNING,
           "the first gyro drifted from the estimator's rates"), inertial.GyroBias),
    (Check("accelerometer_motion", (IMU, "ATTITUDE", "GLOBAL_POSITION_INT"), 0.25, "m/s2", SOURCE_OURS, WARNING,
           "the first accelerometer drifted from the motion"), inertial.AccelerometerMotion),
    (Check("airspeed_zero", (AIRSPEED,), 3.0, "m/s", SOURCE_OURS, FAULT,
           "airspeed reads next to nothing in flight"), airspeed.Zero),
    (Check("airspeed_stuck", (AIRSPEED,), 10.0, "s", SOURCE_OURS, FAULT,
           "airspeed is stuck in flight"), airspeed.Stuck),
    (Check("airspeed_scale", (AIRSPEED, "GPS_RAW_INT", "ATTITUDE"), 0.10, "", SOURCE_OURS, WARNING,
           "airspeed parted from ground speed and heading"), airspeed.Scale),
    (Check("compass_field", (IMUS,), 0.25, "", "ArduPilot LogAnalyzer, field change warning", WARNING,
           "the magnetic field's strength changes"), compass.Field),
    (Check("compass_pair", (IMU, SECOND), 75.0, "mG", SOURCE_OURS, WARNING,
           "compasses drifted apart"), partial(inertial.Pair, quantity=inertial.COMPASSES)),
    (Check("compass_offset", (IMU, "ATTITUDE"), 75.0, "mG", SOURCE_OURS, WARNING,
           "a compass offset came up in flight"), compass.Offset),
    (Check("heading_course", ("ATTITUDE", "GPS_RAW_INT"), 45.0, "deg", "ArduPilot pre-arm check: compasses 45 deg apart",
           WARNING, "heading far from the course over ground"), compass.HeadingCourse),
    (Check("baro_height", ("SCALED_PRESSURE", "GPS_RAW_INT"), 15.0, "m", SOURCE_OURS, WARNING,
           "barometer and GPS height parted"), height.BarometerHeight),
)

# Two more are built around the bench's own clock.
REBOOT: Final = Check("reboot", ("HEARTBEAT",), 2.0, "s", "MAVLink routing guide: boot time going back", WARNING,
                      "the vehicle rebooted")
CLOCK: Final = Check("clock", ("HEARTBEAT",), 1.5, "", SOURCE_OURS, WARNING, "clocks disagree")
# fmt: on

CHECKS: Final = (*(check for check, _ in ROWS), REBOOT, CLOCK)
