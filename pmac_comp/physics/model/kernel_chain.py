"""The elastic chain as the compiled loop steps it: exact step matrices along the screw.

What lives here: numba code only, SI, flat arrays (places in ``slots``). What may not: friction,
controller, units other than SI. Imports ``slots`` only.

Source: Lagrange's equations with q = motor angle, screw angle and screw shift at the nut, table,
all coupled through the nut's deflection ``x_t - rho theta_s - u_s``; scaling
and squaring of the matrix exponential.
"""

import math

import numpy as np
from numba import njit

from pmac_comp.base.arrays import FloatArray
from pmac_comp.physics.model import slots as s

# Inputs of a substep: motor torque, fading motor torque, nut torque, table force, joint force.
N_STATES = 8
N_COLUMNS = 13
_TAYLOR = 9


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_inverse(matrix: FloatArray, size: int) -> FloatArray:
    """Inverse by Gauss-Jordan with pivoting; small matrices only."""
    work = np.zeros((size, 2 * size))
    for i in range(size):
        for j in range(size):
            work[i, j] = matrix[i, j]
        work[i, size + i] = 1.0
    for i in range(size):
        pivot = i
        for r in range(i + 1, size):
            if abs(work[r, i]) > abs(work[pivot, i]):
                pivot = r
        if pivot != i:
            for c in range(2 * size):
                work[i, c], work[pivot, c] = work[pivot, c], work[i, c]
        scale = 1.0 / work[i, i]
        for c in range(2 * size):
            work[i, c] *= scale
        for r in range(size):
            if r != i:
                factor = work[r, i]
                for c in range(2 * size):
                    work[r, c] -= factor * work[i, c]
    return work[:, size:].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def share_of_bed(par: FloatArray) -> float:
    """Mass with which a table moves relative to a bed that gives way, over its own mass.

    Two bodies that push each other off part with the reduced mass M m_b / (M + m_b).
    """
    bed = par[s.BASE_MASS]
    return float(bed / (bed + par[s.M_TABLE])) if bed > 0.0 else 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def chain_matrices(par: FloatArray, x_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mass, damping and stiffness of [motor angle, screw angle, screw axial, table] at x."""
    mass = np.zeros((4, 4))
    damping = np.zeros((4, 4))
    stiffness = np.zeros((4, 4))
    length = par[s.LENGTH]
    x = min(max(x_m, 1e-3 * length), length)
    flexibility = 1.0 / par[s.K_COUPLING] + x / par[s.GJ]
    a = 1.0 / par[s.K_COUPLING] / flexibility
    axial = 1.0 / par[s.K_BEARING] + x / par[s.EA]
    b = 1.0 / par[s.K_BEARING] / axial
    near = par[s.J_SCREW] * x / length
    # The coupling output turns by (1-a) theta_m + a theta_s; the screw is linear from there.
    c0 = 1.0 - a
    mass[0, 0] = par[s.J_MOTOR] + (par[s.J_COUPLING] + near / 3.0) * c0 * c0
    mass[0, 1] = (par[s.J_COUPLING] + near / 3.0) * c0 * a + near / 6.0 * c0
    mass[1, 0] = mass[0, 1]
    mass[1, 1] = (
        (par[s.J_COUPLING] + near / 3.0) * a * a
        + near / 3.0 * (a + 1.0)
        + par[s.J_SCREW] * (1.0 - x / length)
    )
    mass[2, 2] = par[s.M_SCREW] * (x / length / 3.0 * (b * b + b + 1.0) + 1.0 - x / length)
    mass[3, 3] = par[s.M_TABLE] * share_of_bed(par)
    k_torsion = 1.0 / flexibility
    stiffness[0, 0] += k_torsion
    stiffness[0, 1] -= k_torsion
    stiffness[1, 0] -= k_torsion
    stiffness[1, 1] += k_torsion
    stiffness[2, 2] += 1.0 / axial
    rho = par[s.LEAD]
    v = np.array([0.0, -rho, -1.0, 1.0])
    for i in range(4):
        for j in range(4):
            stiffness[i, j] += par[s.K_NUT] * v[i] * v[j]
            damping[i, j] = par[s.BETA] * stiffness[i, j]
    damping[0, 0] += par[s.MOTOR + s.VISCOUS]
    damping[1, 1] += par[s.NUT + s.VISCOUS]
    damping[3, 3] += par[s.GUIDE + s.VISCOUS]
    return mass, damping, stiffness


@njit(cache=True, nogil=True, error_model="numpy")
def _chain_system(par: FloatArray, x_m: float) -> tuple[FloatArray, float]:
    """Continuous matrices [A | B] (8 x 13) at x and a bound of their rates in 1/s."""
    rho = par[s.LEAD]
    system = np.zeros((N_STATES, N_COLUMNS))
    if par[s.RIGID] > 0.5:
        inertia = par[s.RIGID_MASS] * share_of_bed(par) * rho * rho
        drag = (
            par[s.GUIDE + s.VISCOUS] * rho * rho + par[s.NUT + s.VISCOUS] + par[s.MOTOR + s.VISCOUS]
        )
        ratio = np.array([1.0, 1.0, 0.0, rho])
        gain = np.array([1.0, 1.0, 1.0, rho, 0.0])
        for i in range(4):
            system[i, 4] = ratio[i]
            system[4 + i, 4] = -ratio[i] * drag / inertia
            for c in range(5):
                system[4 + i, 8 + c] = ratio[i] * gain[c] / inertia
        return system, drag / inertia
    mass, damping, stiffness = chain_matrices(par, x_m)
    inverse = _solve_inverse(mass, 4)
    columns = np.zeros((4, 5))
    columns[0, 0] = 1.0
    columns[0, 1] = 1.0
    columns[1, 2] = 1.0
    columns[3, 3] = 1.0
    columns[1, 4] = rho
    columns[2, 4] = 1.0
    columns[3, 4] = -1.0
    trace = 0.0
    drag = 0.0
    for i in range(4):
        system[i, 4 + i] = 1.0
        for j in range(4):
            k_sum = 0.0
            c_sum = 0.0
            for n in range(4):
                k_sum += inverse[i, n] * stiffness[n, j]
                c_sum += inverse[i, n] * damping[n, j]
            system[4 + i, j] = -k_sum
            system[4 + i, 4 + j] = -c_sum
            if i == j:
                trace += k_sum
                drag += c_sum
        for c in range(5):
            total = 0.0
            for n in range(4):
                total += inverse[i, n] * columns[n, c]
            system[4 + i, 8 + c] = total
    # The trace of M^-1 K is the sum of the squared natural frequencies: a bound of the largest.
    return system, max(math.sqrt(trace), drag)


@njit(cache=True, nogil=True, error_model="numpy")
def step_matrices(par: FloatArray, x_m: float, step_s: float) -> FloatArray:
    """Exact step of the chain at x over ``step_s``: [A | B], shape (8, 13).

    Taylor series of the scaled exponential, then squaring; the second input fades with the
    current loop.
    """
    system, rate = _chain_system(par, x_m)
    fade = par[s.CURRENT_RATE]
    rate = max(rate, fade)
    halvings = 0
    h = step_s
    while rate * h > 0.25 and halvings < 40:
        h *= 0.5
        halvings += 1
    result = np.zeros((N_STATES, N_COLUMNS))
    low = np.exp(-fade * h)
    for i in range(N_STATES):
        result[i, i] = 1.0
    term = result.copy()
    for n in range(1, _TAYLOR + 1):
        # term <- term * G h / n with G = [[A, B], [0, diag(0, -fade, 0, 0, 0)]]
        following = np.zeros((N_STATES, N_COLUMNS))
        for i in range(N_STATES):
            for j in range(N_COLUMNS):
                total = 0.0
                for m in range(N_STATES):
                    total += term[i, m] * system[m, j]
                if j == 9:
                    total -= term[i, 9] * fade
                following[i, j] = total * h / n
        term = following
        for i in range(N_STATES):
            for j in range(N_COLUMNS):
                result[i, j] += term[i, j]
    for _ in range(halvings):
        squared = np.zeros((N_STATES, N_COLUMNS))
        for i in range(N_STATES):
            for j in range(N_COLUMNS):
                total = 0.0
                for m in range(N_STATES):
                    total += result[i, m] * result[m, j]
                if j == 9:
                    total += result[i, 9] * low
                elif j > 7:
                    total += result[i, j]
                squared[i, j] = total
        low *= low
        result = squared
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def step_bank(par: FloatArray, first_m: float, spacing_m: float, n_nodes: int, step_s: float):  # type: ignore[no-untyped-def] # noqa: ANN201
    """Transposed step matrices at equidistant nodes along the screw, shape (n_nodes, 13, 8)."""
    bank = np.zeros((n_nodes, N_COLUMNS, N_STATES))
    for node in range(n_nodes):
        bank[node] = step_matrices(par, first_m + node * spacing_m, step_s).T
    return bank
