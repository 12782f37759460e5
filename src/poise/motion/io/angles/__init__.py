"""Joint angles of a published model: DeepMimic and OpenSim."""
