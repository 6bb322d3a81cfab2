"""The test rig off line: recordings, the files they come from and go to, an emulated rig."""
