"""Diagnosis of multirotors: regression of specific force, angular acceleration and sensors on effects with onsets.

flight       telemetry of one multirotor on a grid, motors and their places on the frame
model        rotor model with effects, residuals of thirteen channels
linearise    residuals whitened by nominal flights, with derivatives by parameters, wind, biases and effects
baseline     calibration on nominal flights, model file
search       gains and evidence of every effect and onset, sets of up to two effects
diagnose     decision and report of one flight
control_loss loss of control from attitude and motor outputs alone
"""
