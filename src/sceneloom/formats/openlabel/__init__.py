"""ASAM OpenLABEL 1.0: what is stated about a drive, as one file of JSON, and the sensors that it is stated for."""
