"""The whole-mechanism filter: all IMUs in one estimate of the platform's motion, with the errors of the sensors."""
