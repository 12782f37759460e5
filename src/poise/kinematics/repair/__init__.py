"""The motion doctor: faults that no body can have done, found, told and mended."""
