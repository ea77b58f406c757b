"""Vectors between the lab frame and the frame of a body, for kernels."""

from rigidmd.compile import kernel


@kernel(inline=True)
def body_component(rotation, vector_lab, k):
    """Component of a lab vector (3,) along body axis k."""
    return (
        rotation[0, k] * vector_lab[0]
        + rotation[1, k] * vector_lab[1]
        + rotation[2, k] * vector_lab[2]
    )


@kernel(inline=True)
def body_vector(rotation, vector_lab):
    """The components of a lab vector (3,) along the body axes."""
    q, v = rotation, vector_lab
    return body_component(q, v, 0), body_component(q, v, 1), body_component(q, v, 2)


@kernel(inline=True)
def lab_vector(rotation, x, y, z):
    """The components along the lab axes of a vector with components x, y, z along the body axes."""
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z,
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z,
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z,
    )
