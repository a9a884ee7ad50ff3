"""The contenders, each a program that `bench.dataplane.remote` starts and controls."""
