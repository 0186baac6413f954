"""What results depend on: found while they are made, and compared with what is here now."""
