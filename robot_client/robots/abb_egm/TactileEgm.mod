MODULE TactileEgm
    ! Guidance server for tactile-insertion: EGM position guidance in the frame of the gap. Task T_ROB1, options
    ! 689-1 Externally Guided Motion and 616-1 PC Interface, RobotWare 6.07 or newer. Not a safety function.
    !
    ! Configuration (Communication / Transmission Protocol): name TactilePC, type UDPUC, remote address and port of
    ! the cell PC (default port 6510). EGM configuration "default" (Motion / External Motion Interface Data): with
    ! "Return to Programmed Position when Stopped" a stop would drive back to where guidance began; it must be No.
    ! Start it through RWS or the pendant in AUTO with motors on; cycle mode does not matter, the program ends itself.

    ! Adapt both: the TCP lies midway between the fingertips, its z axis points out of the gripper; the work object's
    ! origin is the centre of the gap at the height of the blocks' top faces, x across the gap, z up.
    PERS tooldata tactileTool := [TRUE, [[0, 0, 260], [1, 0, 0, 0]], [2.5, [0, 0, 110], [1, 0, 0, 0], 0, 0, 0]];
    TASK PERS wobjdata tactileGap := [FALSE, TRUE, "", [[800, 0, 300], [1, 0, 0, 0]], [[0, 0, 0], [1, 0, 0, 0]]];

    CONST num silenceLimit := 0.25; ! s without a message of the guide: guidance ends, the arm holds
    CONST num deviationLimit := 100; ! deg/s of a joint: the most that EGM may add
    CONST egm_minmax converged := [-0.05, 0.05];
    CONST pose noOffset := [[0, 0, 0], [1, 0, 0, 0]];

    VAR egmident guide;

    PROC main()
        VAR jointtarget here;
        ! EGM begins at a fine point only, and not as the first motion after a restart of the controller. So the first
        ! one is this, which leads nowhere.
        here := CJointT();
        MoveAbsJ here, v10, fine, tactileTool \WObj:=tactileGap;
        EGMReset guide;
        EGMGetId guide;
        EGMSetupUC ROB_1, guide, "default", "TactilePC" \Pose \CommTimeout:=silenceLimit;
        EGMActPose guide \Tool:=tactileTool \WObj:=tactileGap, noOffset, EGM_FRAME_WOBJ, noOffset, EGM_FRAME_WOBJ
            \x:=converged \y:=converged \z:=converged \rx:=converged \ry:=converged \rz:=converged
            \LpFilter:=20 \SampleRate:=4 \MaxSpeedDeviation:=deviationLimit;
        ! HOLD, never RAMP_DOWN: ramping down drives back to where guidance began, through whatever is there now.
        ! CondTime keeps the run alive while the arm stands still on its target.
        EGMRunPose guide, EGM_STOP_HOLD \x \y \z \rx \ry \rz \CondTime:=86400 \RampInTime:=0.05 \RampOutTime:=0.5
            \PosCorrGain:=1;
        EGMReset guide;
    ERROR
        IF ERRNO = ERR_UDPUC_COMM THEN
            ErrWrite \W, "tactile-insertion: the guide fell silent", "The arm holds. Start the program again.";
        ENDIF
        EGMReset guide;
        EXIT;
    ENDPROC
ENDMODULE
