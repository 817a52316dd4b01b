"""Says which extra to install where a library of the service is missing; loaded before its other modules."""

from importlib import import_module

from sceneloom.errors import MissingExtraError, how_to_install

EXTRA = "serve"
"""The extra of the package that the service needs."""

for _name in ("google.protobuf", "grpc", "grpc_health", "grpc_reflection"):
    try:
        import_module(_name)
    except ImportError as missing:
        raise MissingExtraError(f"{missing}; install the extra: {how_to_install(EXTRA)}") from missing
