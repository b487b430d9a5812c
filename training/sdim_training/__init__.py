"""Trains sdim's small models in PyTorch on records that the crate writes (`examples/records.rs`)."""
