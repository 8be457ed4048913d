"""One step of a discretised Luenberger observer, for a bank of inputs over a batch of flights."""

import numpy as np
from numpy.typing import NDArray


def observer_step(
    state: NDArray[np.float64],
    transition: NDArray[np.float64],
    input_vector: NDArray[np.float64],
    feedback: NDArray[np.float64],
    inputs: NDArray[np.float64],
    measured: NDArray[np.float64],
) -> NDArray[np.float64]:
    """x[k+1] = Phi x[k] + G u[k] + K y[k]; -> the new state, (state, hypothesis, flight).

    state: (state, hypothesis, flight); transition Phi: (state, state), input_vector G and feedback K: (state,), the exact
    zero-order hold of A - L C with the inputs b and L; inputs u: (hypothesis, flight); measured y: (flight,).
    Sums are written out state by state, so that a flight has the same bits alone and in company.
    Source: parafoil paper, Eqs. 8, 18, 20, 24.
    """
    column = (slice(None), None, None)
    new: NDArray[np.float64] = transition[:, 0][column] * state[0]
    for j in range(1, state.shape[0]):
        new += transition[:, j][column] * state[j]
    new += input_vector[column] * inputs
    new += feedback[column] * measured
    return new


def observer_output(state: NDArray[np.float64], output: NDArray[np.float64]) -> NDArray[np.float64]:
    """y-hat = C x-hat, (hypothesis, flight), in the output's unit; output C: (state,).  Source: Eqs. 9, 19, 21, 25."""
    estimate: NDArray[np.float64] = output[0] * state[0]
    for j in range(1, state.shape[0]):
        estimate += output[j] * state[j]
    return estimate
