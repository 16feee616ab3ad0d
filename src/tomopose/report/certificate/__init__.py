"""The certificate of a calibration: one page to sign, and the same as a digital calibration certificate (DCC)."""
