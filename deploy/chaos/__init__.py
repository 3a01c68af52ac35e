"""Fault injection: a training whose processes are killed, frozen and delayed."""
