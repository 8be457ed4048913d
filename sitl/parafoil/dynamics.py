"""Flight mechanics of the parafoil and its payload: mass, apparent mass, aerodynamics, motors, integration.

One rigid body, six degrees of freedom, body axes FRD at the common centre of gravity, z along the lines; kernels over one
flight.  Wind, guidance, sensors and faults are elsewhere.

Sources: weights, area, span, chord from Stoeckle, Fejzic, Breger, How, "Fault Detection and Isolation for Autonomous
Parafoils"; apparent mass from Lissaman & Brown, "Apparent mass effects on parafoil dynamics", AIAA 93-1236; everything
marked (c) is a choice of ours that gives plausible trim and turn rates, see docs/parafoil.md.
"""

import math

import numpy as np
from numpy.typing import NDArray

from sitl.kernel import plant_kernel

GRAVITY_M_S2 = 9.80665
SEA_LEVEL_DENSITY_KG_M3 = 1.225

CANOPY_AREA_M2 = 83.6127  # 900 ft2
SPAN_M = 15.24  # 50 ft
CHORD_M = 4.8768  # 16 ft; span times chord is 800 ft2, not 900: area serves forces, span and chord moments
CANOPY_MASS_KG = 31.751  # 70 lb
PAYLOAD_MASS_KG = 816.466  # 1800 lb
LINES_M = 10.0  # canopy to payload (c)
PAYLOAD_LENGTH_M, PAYLOAD_WIDTH_M, PAYLOAD_HEIGHT_M = 1.2, 1.2, 1.5  # (c)
PAYLOAD_DRAG_AREA_M2 = 1.6  # (c)
RIGGING_RAD = math.radians(-9.0)  # incidence of the canopy (c)
RELATIVE_THICKNESS = 0.12  # (c)
RELATIVE_ARC = 0.15  # height of the canopy's arc over its span (c)

TRAVEL_M = 1.40  # of a control line (c)
MOTOR_LAG_S = 0.25  # (c)
MOTOR_RATE_M_S = 0.70  # (c)
TOGGLE_RANGE_M = 1.5  # line pulled at 2000 us
GLIDE_AIRSPEED_M_S = 18.0  # near the ground, for time constants of turbulence
DC_GAIN_RAD_S_M = 0.365  # turn rate for a metre of differential toggle, at 2000 m

_THICKNESS_M = RELATIVE_THICKNESS * CHORD_M
_ASPECT = SPAN_M * SPAN_M / CANOPY_AREA_M2
_ARC2 = RELATIVE_ARC * RELATIVE_ARC
_THIN = 1.0 - RELATIVE_THICKNESS * RELATIVE_THICKNESS
# apparent mass (m3) and inertia (m5) for a unit of density, Lissaman & Brown
APPARENT_A_M3 = 0.666 * (1.0 + 8.0 * _ARC2 / 3.0) * _THICKNESS_M * _THICKNESS_M * SPAN_M
APPARENT_B_M3 = 0.267 * (_THICKNESS_M * _THICKNESS_M + 2.0 * _ARC2 * SPAN_M * SPAN_M * _THIN) * CHORD_M
APPARENT_C_M3 = 0.785 * math.sqrt(1.0 + 2.0 * _ARC2 * _THIN) * _ASPECT / (1.0 + _ASPECT) * CHORD_M * CHORD_M * SPAN_M
APPARENT_XX_M5 = 0.055 * _ASPECT / (1.0 + _ASPECT) * SPAN_M**3 * CHORD_M**2
APPARENT_YY_M5 = 0.0308 * _ASPECT / (1.0 + _ASPECT) * CHORD_M**4 * SPAN_M
APPARENT_ZZ_M5 = 0.0555 * (1.0 + 8.0 * _ARC2) * _THICKNESS_M**2 * SPAN_M**3
ENCLOSED_AIR_M3 = 0.09 * CHORD_M * CHORD_M * SPAN_M  # has inertia, no weight (c)

# columns of a state, (STATES,): position NED m, inertial velocity in body axes m/s, rates rad/s, Euler angles rad
NORTH, EAST, DOWN, U, V, W, P, Q, R, PHI, THETA, PSI = range(12)
STATES = 12

# columns of a body, (BODY,): what is peculiar to this vehicle and stays for the flight
(
    MASS_KG,
    CANOPY_ARM_M,  # canopy above the centre of gravity
    PAYLOAD_ARM_M,  # payload below it
    RIGID_XX_KG_M2,
    RIGID_YY_KG_M2,
    RIGID_ZZ_KG_M2,
    DRAG_FACTOR,
    TURN_FACTOR,
    TURN_BIAS_M,  # a built-in pull on the right line
    LINE_FACTOR_LEFT,
    LINE_FACTOR_RIGHT,
    RATE_FACTOR_1,
    RATE_FACTOR_2,
    LAG_FACTOR_1,
    LAG_FACTOR_2,
    PAYLOAD_FACTOR,
) = range(16)
BODY = 16

# columns of the held quantities, (HELD,): what depends on density and is renewed each second
DENSITY, APPARENT_A, APPARENT_B, APPARENT_C, TOTAL_XX, TOTAL_YY, TOTAL_ZZ = range(7)
INVERSE_UU, INVERSE_UQ, INVERSE_QQ, INVERSE_VV, INVERSE_VP, INVERSE_PP, INVERSE_WW, INVERSE_RR = range(7, 15)
HELD = 15

# columns of the air, (AIR,): wind NED m/s, roll and yaw gust rad/s
WIND_NORTH, WIND_EAST, WIND_DOWN, GUST_P, GUST_R = range(5)
AIR = 5


@plant_kernel
def density_kg_m3(altitude_m: float) -> float:
    """Air density, kg/m3, at an altitude above sea level, m, below 11 km.  Source: ICAO standard atmosphere."""
    return SEA_LEVEL_DENSITY_KG_M3 * math.pow(1.0 - 2.25577e-5 * altitude_m, 4.2559)


@plant_kernel
def fill_body(body: NDArray[np.float64], payload_factor: float) -> None:
    """Write mass, arms and rigid inertia for a payload of payload_factor times the nominal one into body, (BODY,)."""
    payload = PAYLOAD_MASS_KG * payload_factor
    mass = CANOPY_MASS_KG + payload
    up = LINES_M * payload / mass
    down = LINES_M * CANOPY_MASS_KG / mass
    depth2 = PAYLOAD_LENGTH_M * PAYLOAD_LENGTH_M + PAYLOAD_HEIGHT_M * PAYLOAD_HEIGHT_M
    arms = payload * down * down + CANOPY_MASS_KG * up * up
    body[PAYLOAD_FACTOR] = payload_factor
    body[MASS_KG] = mass
    body[CANOPY_ARM_M] = up
    body[PAYLOAD_ARM_M] = down
    body[RIGID_XX_KG_M2] = payload * depth2 / 12.0 + arms + CANOPY_MASS_KG * SPAN_M * SPAN_M / 12.0
    body[RIGID_YY_KG_M2] = payload * depth2 / 12.0 + arms + CANOPY_MASS_KG * CHORD_M * CHORD_M / 12.0
    body[RIGID_ZZ_KG_M2] = (
        payload * (PAYLOAD_LENGTH_M * PAYLOAD_LENGTH_M + PAYLOAD_WIDTH_M * PAYLOAD_WIDTH_M) / 12.0
        + CANOPY_MASS_KG * (SPAN_M * SPAN_M + CHORD_M * CHORD_M) / 12.0
    )


def nominal_body() -> NDArray[np.float64]:
    """The nominal vehicle, (BODY,): all factors 1, no bias."""
    body = np.ones(BODY)
    fill_body(body, 1.0)
    body[TURN_BIAS_M] = 0.0
    return body


@plant_kernel
def hold(held: NDArray[np.float64], body: NDArray[np.float64], density: float) -> None:
    """Write density, kg/m3, the apparent masses and the inverse generalised mass at it into held, (HELD,).

    Apparent mass acts at the canopy's point, above the centre of gravity by the arm z, whose velocity is
    (u - q z, v + p z, w).  So the 6x6 generalised mass couples u with q by -A z and v with p by +B z and nothing else,
    and its inverse is that of two 2x2 blocks and two numbers.
    """
    enclosed = density * ENCLOSED_AIR_M3
    a = density * APPARENT_A_M3 + enclosed
    b = density * APPARENT_B_M3 + enclosed
    c = density * APPARENT_C_M3 + enclosed
    held[DENSITY] = density
    held[APPARENT_A] = a
    held[APPARENT_B] = b
    held[APPARENT_C] = c
    held[TOTAL_XX] = body[RIGID_XX_KG_M2] + density * APPARENT_XX_M5 + enclosed * SPAN_M * SPAN_M / 12.0
    held[TOTAL_YY] = body[RIGID_YY_KG_M2] + density * APPARENT_YY_M5 + enclosed * CHORD_M * CHORD_M / 12.0
    held[TOTAL_ZZ] = (
        body[RIGID_ZZ_KG_M2] + density * APPARENT_ZZ_M5 + enclosed * (SPAN_M * SPAN_M + CHORD_M * CHORD_M) / 12.0
    )
    arm = body[CANOPY_ARM_M]
    u = body[MASS_KG] + a
    q = held[TOTAL_YY] + a * arm * arm
    determinant = u * q - a * arm * (a * arm)
    held[INVERSE_UU] = q / determinant
    held[INVERSE_UQ] = a * arm / determinant
    held[INVERSE_QQ] = u / determinant
    v = body[MASS_KG] + b
    p = held[TOTAL_XX] + b * arm * arm
    determinant = v * p - b * arm * (b * arm)
    held[INVERSE_VV] = p / determinant
    held[INVERSE_VP] = -b * arm / determinant
    held[INVERSE_PP] = v / determinant
    held[INVERSE_WW] = 1.0 / (body[MASS_KG] + c)
    held[INVERSE_RR] = 1.0 / held[TOTAL_ZZ]


@plant_kernel
def line_effect_m(deflection_m: float) -> float:
    """How a deflection of the trailing edge, m, counts for turning: a line pulled far does less for each metre (c)."""
    return deflection_m - 0.18 * deflection_m * deflection_m


@plant_kernel
def derivative(
    state: NDArray[np.float64],
    line_left_m: float,
    line_right_m: float,
    air: NDArray[np.float64],
    body: NDArray[np.float64],
    held: NDArray[np.float64],
    rate: NDArray[np.float64],
) -> None:
    """Write d(state)/dt, (STATES,), SI, into rate.

    Equation: M d(v, omega)/dt = [F; r x F' + M_aero + r_p x F_payload - omega x (I omega)], where the force at the
    canopy's point r includes the apparent-mass term -omega x (diag(A, B, C) v_air).  That term takes the air-relative
    velocity; the steady Munk moment is taken to be inside the aerodynamic coefficients, and the acceleration of the
    wind is left out.  Aerodynamic form as usual for six-degree-of-freedom parafoils (Slegers & Costello), values (c).
    """
    u, v, w = state[U], state[V], state[W]
    p, q, r = state[P], state[Q], state[R]
    sin_phi, cos_phi = math.sin(state[PHI]), math.cos(state[PHI])
    sin_theta, cos_theta = math.sin(state[THETA]), math.cos(state[THETA])
    sin_psi, cos_psi = math.sin(state[PSI]), math.cos(state[PSI])
    # direction cosines, body to NED
    xn, yn, zn = (
        cos_theta * cos_psi,
        sin_phi * sin_theta * cos_psi - cos_phi * sin_psi,
        cos_phi * sin_theta * cos_psi + sin_phi * sin_psi,
    )
    xe, ye, ze = (
        cos_theta * sin_psi,
        sin_phi * sin_theta * sin_psi + cos_phi * cos_psi,
        cos_phi * sin_theta * sin_psi - sin_phi * cos_psi,
    )
    xd, yd, zd = -sin_theta, sin_phi * cos_theta, cos_phi * cos_theta

    wn, we, wd = air[WIND_NORTH], air[WIND_EAST], air[WIND_DOWN]
    ua = u - (xn * wn + xe * we + xd * wd)
    va = v - (yn * wn + ye * we + yd * wd)
    wa = w - (zn * wn + ze * we + zd * wd)
    arm, payload_arm = body[CANOPY_ARM_M], body[PAYLOAD_ARM_M]
    uc, vc, wc = ua - q * arm, va + p * arm, wa
    up, vp, wp = ua + q * payload_arm, va - p * payload_arm, wa

    density = held[DENSITY]
    speed = math.sqrt(uc * uc + vc * vc + wc * wc)
    alpha = math.atan2(wc, uc) + RIGGING_RAD
    beta = math.asin(vc / speed)
    pressure_area = 0.5 * density * speed * speed * CANOPY_AREA_M2
    asymmetric = line_effect_m(line_right_m) * body[LINE_FACTOR_RIGHT] - line_effect_m(line_left_m) * body[LINE_FACTOR_LEFT]
    symmetric = 0.5 * (line_left_m + line_right_m)
    lift_coefficient = 0.30 + 2.2 * alpha + 0.15 * symmetric
    if alpha > 0.30:
        lift_coefficient -= 3.0 * (alpha - 0.30)
    drag_coefficient = 0.090 * body[DRAG_FACTOR] + 0.13 * lift_coefficient * lift_coefficient + 0.06 * symmetric
    half_span = SPAN_M / (2.0 * speed)
    p_air, r_air = (p - air[GUST_P]) * half_span, (r - air[GUST_R]) * half_span
    roll_coefficient = -0.25 * p_air + 0.06 * r_air - 0.001 * asymmetric
    pitch_coefficient = -1.2 * q * CHORD_M / (2.0 * speed)
    yaw_coefficient = (
        0.004 * beta - 0.02 * p_air - 0.070 * r_air + 0.0100 * body[TURN_FACTOR] * (asymmetric + body[TURN_BIAS_M])
    )

    lift, drag = pressure_area * lift_coefficient, pressure_area * drag_coefficient
    a, b, c = held[APPARENT_A], held[APPARENT_B], held[APPARENT_C]
    # aerodynamic force at the canopy's point, with the apparent-mass term
    fx = lift * wc / speed - drag * uc / speed - (q * c * wc - r * b * vc)
    fy = pressure_area * (-0.40 * beta) - drag * vc / speed - (r * a * uc - p * c * wc)
    fz = -lift * uc / speed - drag * wc / speed - (p * b * vc - q * a * uc)
    payload_drag = -0.5 * density * PAYLOAD_DRAG_AREA_M2 * math.sqrt(up * up + vp * vp + wp * wp)
    px, py, pz = payload_drag * up, payload_drag * vp, payload_drag * wp

    mass = body[MASS_KG]
    x = fx + px + mass * (GRAVITY_M_S2 * xd - (q * w - r * v))
    y = fy + py + mass * (GRAVITY_M_S2 * yd - (r * u - p * w))
    z = fz + pz + mass * (GRAVITY_M_S2 * zd - (p * v - q * u))
    xx, yy, zz = held[TOTAL_XX], held[TOTAL_YY], held[TOTAL_ZZ]
    roll = arm * fy + pressure_area * SPAN_M * roll_coefficient - payload_arm * py - (zz - yy) * q * r
    pitch = -arm * fx + pressure_area * CHORD_M * pitch_coefficient + payload_arm * px - (xx - zz) * r * p
    yaw = pressure_area * SPAN_M * yaw_coefficient - (yy - xx) * p * q

    rate[NORTH] = xn * u + yn * v + zn * w
    rate[EAST] = xe * u + ye * v + ze * w
    rate[DOWN] = xd * u + yd * v + zd * w
    rate[U] = held[INVERSE_UU] * x + held[INVERSE_UQ] * pitch
    rate[V] = held[INVERSE_VV] * y + held[INVERSE_VP] * roll
    rate[W] = held[INVERSE_WW] * z
    rate[P] = held[INVERSE_VP] * y + held[INVERSE_PP] * roll
    rate[Q] = held[INVERSE_UQ] * x + held[INVERSE_QQ] * pitch
    rate[R] = held[INVERSE_RR] * yaw
    turning = q * sin_phi + r * cos_phi
    rate[PHI] = p + turning * sin_theta / cos_theta  # no gimbal risk: a parafoil does not pitch up to the vertical
    rate[THETA] = q * cos_phi - r * sin_phi
    rate[PSI] = turning / cos_theta


@plant_kernel
def velocity_ned_m_s(state: NDArray[np.float64]) -> tuple[float, float, float]:
    """Velocity over ground, NED, m/s, of a state, (STATES,)."""
    u, v, w = state[U], state[V], state[W]
    sin_phi, cos_phi = math.sin(state[PHI]), math.cos(state[PHI])
    sin_theta, cos_theta = math.sin(state[THETA]), math.cos(state[THETA])
    sin_psi, cos_psi = math.sin(state[PSI]), math.cos(state[PSI])
    level = cos_theta * u + sin_phi * sin_theta * v + cos_phi * sin_theta * w  # along the yaw angle
    across = cos_phi * v - sin_phi * w
    down = -sin_theta * u + sin_phi * cos_theta * v + cos_phi * cos_theta * w
    return cos_psi * level - sin_psi * across, sin_psi * level + cos_psi * across, down


@plant_kernel
def ned_to_body(state: NDArray[np.float64], north: float, east: float, down: float) -> tuple[float, float, float]:
    """A vector given in NED, in the body axes of a state, (STATES,); any unit."""
    sin_phi, cos_phi = math.sin(state[PHI]), math.cos(state[PHI])
    sin_theta, cos_theta = math.sin(state[THETA]), math.cos(state[THETA])
    sin_psi, cos_psi = math.sin(state[PSI]), math.cos(state[PSI])
    level = cos_psi * north + sin_psi * east
    across = -sin_psi * north + cos_psi * east
    lower = sin_theta * level + cos_theta * down
    return (
        cos_theta * level - sin_theta * down,
        sin_phi * lower + cos_phi * across,
        cos_phi * lower - sin_phi * across,
    )


@plant_kernel
def runge_kutta(
    state: NDArray[np.float64],
    line_left_m: float,
    line_right_m: float,
    air: NDArray[np.float64],
    body: NDArray[np.float64],
    held: NDArray[np.float64],
    dt_s: float,
    work: NDArray[np.float64],
) -> None:
    """Advance state by dt_s, in place, lines and air held; work: (5, STATES), overwritten.  Classical, fourth order.

    Its last row but one, work[3], is then the derivative near the new state: the sensors take their acceleration there.
    """
    derivative(state, line_left_m, line_right_m, air, body, held, work[0])
    for i in range(STATES):
        work[4, i] = state[i] + 0.5 * dt_s * work[0, i]
    derivative(work[4], line_left_m, line_right_m, air, body, held, work[1])
    for i in range(STATES):
        work[4, i] = state[i] + 0.5 * dt_s * work[1, i]
    derivative(work[4], line_left_m, line_right_m, air, body, held, work[2])
    for i in range(STATES):
        work[4, i] = state[i] + dt_s * work[2, i]
    derivative(work[4], line_left_m, line_right_m, air, body, held, work[3])
    for i in range(STATES):
        state[i] += dt_s / 6.0 * (work[0, i] + 2.0 * (work[1, i] + work[2, i]) + work[3, i])


@plant_kernel
def motor_step(position_m: float, command_m: float, lag_s: float, rate_m_s: float, dt_s: float) -> float:
    """Next position of a line's motor, m: first-order lag with a rate limit (c)."""
    step = (command_m - position_m) * (1.0 - math.exp(-dt_s / lag_s))
    return position_m + min(max(step, -rate_m_s * dt_s), rate_m_s * dt_s)
