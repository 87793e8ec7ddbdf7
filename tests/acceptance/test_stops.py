"""Why a robot stopped is found in the recording alone."""
