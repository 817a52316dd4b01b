"""The protobuf form of the records, generated from `proto/sceneloom/db34t4101/v1/fusion.proto`."""
