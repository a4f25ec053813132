"""The winning scene polished: all objects together, without contact errors, flips settled by colour."""
