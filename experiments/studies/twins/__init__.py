"""Twins: whether a simulation made from a log's first half predicts the errors on its second."""
