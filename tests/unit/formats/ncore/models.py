"""Camera models as NCore states them."""

_COMMON = {"resolution": [640, 480], "shutter_type": "ROLLING_TOP_TO_BOTTOM", "external_distortion_parameters": None}
_FORWARD = [0.0, 310.0, 4.0, -9.5, 2.5, -0.6]


def _ftheta(reference, backward):
    return {
        "camera_model_type": "ftheta",
        "camera_model_parameters": {
            **_COMMON,
            "principal_point": [321.25, 238.5],
            "reference_poly": reference,
            "pixeldist_to_angle_poly": backward,
            "angle_to_pixeldist_poly": _FORWARD,
            "max_angle": 1.3,
            "linear_cde": [1.003, 0.0008, -0.0011],
        },
    }


# of a fit to the inverse of the forward polynomial, rounded
_BACKWARD = [0.0, 0.0032258, -1.34e-07, 1.14e-09, -2.6e-13, 4.1e-16]

MODELS = {
    "ftheta": _ftheta("ANGLE_TO_PIXELDIST", _BACKWARD),
    "ftheta by its inverse": _ftheta("PIXELDIST_TO_ANGLE", _BACKWARD),
    "opencv-pinhole": {
        "camera_model_type": "opencv-pinhole",
        "camera_model_parameters": {
            **_COMMON,
            "principal_point": [318.75, 242.0],
            "focal_length": [402.5, 399.75],
            "radial_coeffs": [-0.28, 0.09, -0.012, 0.02, -0.006, 0.001],
            "tangential_coeffs": [0.0008, -0.0011],
            "thin_prism_coeffs": [0.0011, -0.0004, 0.0006, 0.0002],
        },
    },
    "opencv-fisheye": {
        "camera_model_type": "opencv-fisheye",
        "camera_model_parameters": {
            **_COMMON,
            "principal_point": [319.5, 241.25],
            "focal_length": [262.5, 261.0],
            "radial_coeffs": [0.02, -0.013, 0.004, -0.0009],
            "max_angle": 1.35,
        },
    },
}
