MODULE TactileGuard
    ! Guard for tactile-insertion on a controller without EGM: background task T_TACTILE (type SEMISTATIC, no motion,
    ! trust level SysStop), next to TactileMotion.mod in T_ROB1. It answers where the arm is and raises the stop flag
    ! on request, and by itself when the cell PC is silent for silenceLimit. Not a safety function.
    !
    ! Requests end with "#":   H n#   alive          R n#   lower the stop flag          S n#   raise it
    ! Answer to each:          P n x y z q1 q2 q3 q4 stop#                               mm; the last one 0 or 1

    PERS tooldata tactileTool;
    PERS wobjdata tactileGap;
    PERS bool tactileStop;

    CONST string address := "192.168.125.1"; ! as in TactileMotion.mod
    CONST num port := 5011;
    CONST num silenceLimit := 0.1; ! s: with the reaction to the flag, 1.5 mm at 10 mm/s

    VAR socketdev server;
    VAR socketdev client;

    PROC main()
        VAR string whole := "";
        VAR string part;
        tactileStop := TRUE;
        SocketCreate server;
        SocketBind server, address, port;
        SocketListen server;
        SocketAccept server, client \Time:=WAIT_MAX;
        WHILE TRUE DO
            SocketReceive client \Str:=part \Time:=silenceLimit; ! what has come, 80 bytes at most
            ! A stop anywhere in what came in wins at once, whatever stands before it.
            IF StrFind(part, 1, "S") <= StrLen(part) THEN
                tactileStop := TRUE;
            ENDIF
            IF StrLen(whole) + StrLen(part) > 80 THEN
                whole := "";
                tactileStop := TRUE;
            ENDIF
            whole := obeyAll(whole + part);
        ENDWHILE
    ERROR
        ! Silence, a closed or a broken connection: stop first, then listen again.
        tactileStop := TRUE;
        SocketClose client;
        SocketClose server;
        ExitCycle;
    ENDPROC

    ! Obeys every complete request and returns what is left.
    FUNC string obeyAll(string requests)
        VAR num cut;
        cut := StrFind(requests, 1, "#");
        WHILE cut <= StrLen(requests) DO
            obey StrPart(requests, 1, cut - 1);
            IF cut = StrLen(requests) THEN
                RETURN "";
            ENDIF
            requests := StrPart(requests, cut + 1, StrLen(requests) - cut);
            cut := StrFind(requests, 1, "#");
        ENDWHILE
        RETURN requests;
    ENDFUNC

    PROC obey(string request)
        VAR num number := 0;
        VAR bool good;
        IF StrLen(request) < 3 THEN
            RETURN;
        ENDIF
        good := StrToVal(StrPart(request, 3, StrLen(request) - 2), number);
        IF StrPart(request, 1, 1) = "S" THEN
            tactileStop := TRUE;
        ELSEIF StrPart(request, 1, 1) = "R" AND good THEN
            tactileStop := FALSE;
        ENDIF
        SocketSend client \Str:=status(number);
    ENDPROC

    FUNC string status(num number)
        VAR robtarget here;
        here := CRobT(\TaskName:="T_ROB1" \Tool:=tactileTool \WObj:=tactileGap);
        RETURN "P " + ValToStr(number)
            + " " + NumToStr(here.trans.x, 2) + " " + NumToStr(here.trans.y, 2) + " " + NumToStr(here.trans.z, 2)
            + " " + NumToStr(here.rot.q1, 5) + " " + NumToStr(here.rot.q2, 5)
            + " " + NumToStr(here.rot.q3, 5) + " " + NumToStr(here.rot.q4, 5)
            + flag(tactileStop) + "#";
    ENDFUNC

    FUNC string flag(bool value)
        IF value THEN
            RETURN " 1";
        ENDIF
        RETURN " 0";
    ENDFUNC
ENDMODULE
