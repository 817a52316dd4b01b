"""The fusion system as a service: DB34/T 4101-2022, clause 5, over gRPC (extra `serve`)."""

import sceneloom.service.startup  # noqa: F401 - names the extra where it is missing
