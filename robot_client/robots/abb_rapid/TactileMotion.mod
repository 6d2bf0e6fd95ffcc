MODULE TactileMotion
    ! Motion server for tactile-insertion on a controller without EGM: task T_ROB1, option 616-1 PC Interface.
    ! It moves along straight lines and stops as soon as the guard (TactileGuard.mod, a background task) raises
    ! tactileStop. The guard raises it on request and whenever the cell PC falls silent. Not a safety function.
    !
    ! Requests end with "#":   M id x y z q1 q2 q3 q4 speed#     straight to the pose (mm, mm/s) unless stopped;
    !                                                            a turn is as fast, in deg/s
    ! Answers:                 D id#  done,  S id#  stopped on the way,  E id reason#  refused

    PERS tooldata tactileTool := [TRUE, [[0, 0, 260], [1, 0, 0, 0]], [2.5, [0, 0, 110], [1, 0, 0, 0], 0, 0, 0]];
    PERS wobjdata tactileGap := [FALSE, TRUE, "", [[800, 0, 300], [1, 0, 0, 0]], [[0, 0, 0], [1, 0, 0, 0]]];
    PERS bool tactileStop := TRUE;

    ! Of this controller in the network of the cell PC: here its service port. "127.0.0.1" on a virtual controller.
    CONST string address := "192.168.125.1";
    CONST num port := 5010;
    CONST num topSpeed := 80; ! mm/s; SearchL \Stop is meant for less than 100
    CONST num turnSpeed := 55; ! deg/s; no turn is faster

    VAR socketdev server;
    VAR socketdev client;

    PROC main()
        tactileStop := TRUE;
        ! The program was stopped with both open if the PC ended its last session in a hurry.
        SocketClose client;
        SocketClose server;
        ConfL \Off;
        AccSet 30, 30;
        listen;
        WHILE TRUE DO
            answer handle(nextRequest());
        ENDWHILE
    ERROR
        ! A lost PC is no reason to move: raise the stop and wait for the next connection.
        tactileStop := TRUE;
        SocketClose client;
        SocketClose server;
        WaitTime 0.2;
        ExitCycle;
    ENDPROC

    PROC listen()
        SocketCreate server;
        SocketBind server, address, port;
        SocketListen server;
        SocketAccept server, client \Time:=WAIT_MAX;
    ENDPROC

    ! One request up to its "#". The PC sends the next one after the answer, and RAPID strings end at 80 characters.
    FUNC string nextRequest()
        VAR string whole := "";
        VAR string part;
        VAR bool ended := FALSE;
        WHILE NOT ended DO
            SocketReceive client \Str:=part \Time:=WAIT_MAX; ! what has come, 80 bytes at most
            IF StrLen(whole) + StrLen(part) > 80 THEN
                whole := "";
                answer "E 0 length";
            ELSE
                whole := whole + part;
                ended := StrFind(whole, 1, "#") <= StrLen(whole);
            ENDIF
        ENDWHILE
        RETURN StrPart(whole, 1, StrFind(whole, 1, "#") - 1);
    ENDFUNC

    FUNC string handle(string request)
        VAR num fields{9};
        VAR robtarget target;
        VAR bool arrived;
        IF StrLen(request) < 3 THEN
            RETURN "E 0 format";
        ENDIF
        IF StrPart(request, 1, 2) <> "M " OR NOT numbers(request, fields) THEN
            RETURN "E 0 format";
        ENDIF
        IF fields{9} <= 0 OR fields{9} > topSpeed THEN
            RETURN "E " + ValToStr(fields{1}) + " speed";
        ENDIF
        ! configuration and external axes stay as they are
        target := CRobT(\Tool:=tactileTool \WObj:=tactileGap);
        target.trans := [fields{2}, fields{3}, fields{4}];
        target.rot := NOrient([fields{5}, fields{6}, fields{7}, fields{8}]);
        arrived := travel(target, fields{9});
        IF arrived THEN
            RETURN "D " + ValToStr(fields{1});
        ENDIF
        RETURN "S " + ValToStr(fields{1});
    ENDFUNC

    FUNC bool travel(robtarget target, num speed)
        VAR robtarget hit;
        VAR speeddata v := [10, 10, 100, 100];
        VAR bool ended := FALSE;
        v.v_tcp := speed;
        v.v_ori := speed;
        IF v.v_ori > turnSpeed THEN
            v.v_ori := turnSpeed;
        ENDIF
        ! Hard stop on the flag. Reaching the end without it is ERR_WHLSEARCH, here the good outcome.
        SearchL \Stop, tactileStop \HighLevel, hit, target, v, tactileTool \WObj:=tactileGap;
        RETURN ended;
    ERROR
        IF ERRNO = ERR_WHLSEARCH THEN
            ended := TRUE;
            TRYNEXT;
        ELSEIF ERRNO = ERR_PERSSUPSEARCH OR ERRNO = ERR_SIGSUPSEARCH THEN
            ! The stop was up before the start: nothing moved, and nothing of this move may be left for the next one.
            StopMove;
            ClearPath;
            StartMove;
            TRYNEXT;
        ELSE
            RAISE;
        ENDIF
    ENDFUNC

    FUNC bool numbers(string request, INOUT num fields{*})
        VAR num first := 3;
        VAR num past;
        FOR i FROM 1 TO 9 DO
            past := StrFind(request, first, " ");
            IF NOT StrToVal(StrPart(request, first, past - first), fields{i}) THEN
                RETURN FALSE;
            ENDIF
            first := past + 1;
            IF i < 9 AND first > StrLen(request) THEN
                RETURN FALSE;
            ENDIF
        ENDFOR
        RETURN first > StrLen(request);
    ENDFUNC

    PROC answer(string text)
        SocketSend client \Str:=text + "#";
    ENDPROC
ENDMODULE
