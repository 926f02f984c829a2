"""Commands of the manual's own summary, and which of them the simulated card has.

One example stands for each form that the summary lists. `support` prints these lists; a test asks
the card about every example, so that what is listed is what happens.

Source: Turbo PMAC Software Reference Manual p. 24-34 (summary), 264-485.
"""

from typing import Final

# fmt: off
ON_LINE: Final = (
    "@1", "@", "#1", "#", "##1", "##", "&1", "&", "$$$", "$$$***", "LOCK0,P1", "PASSWORD=abc",
    "SAVE", "TIME=12:00:00", "TODAY=01/02/2003", "UNLOCK0", "UNDEFINE ALL", "???", "CID", "CPU",
    "DATE", "IDNUMBER", "LIST", "LIST PROGRAM 1", "LIST PLC 1", "SID", "SIZE", "TIME", "TODAY",
    "TYPE", "VERSION", "VID", "EAVERSION", "CHECKSUM", "RX$0", "RHX$0,2", "WX$10F0,1",
    "ENABLE PLC 1", "DISABLE PLC 1", "PAUSE PLC 1", "RESUME PLC 1", "DISABLE PLCC 1", "5",
    "I1=1", "I1..3=1", "I130=*", "I103=@I8000", "I1", "I1..3", "P1=1", "P1..3=1", "P1",
    "M1=1", "M1..3=1", "M1->X:$0,24", "M1->*", "M1..3", "M1..3->", "OPEN PROG 1", "OPEN ROT",
    "OPEN PLC 1", "CLOSE", "CLOSE ALL", "CLEAR", "CLEAR ALL", "CLEAR ALL PLCS", "DEFINE GATHER",
    "DELETE GATHER", "GATHER", "GATHER TRIGGER", "ENDGATHER", "LIST GATHER", "DELETE TBUF",
    "DEFINE UBUFFER 10", "DELETE ALL", "DELETE ALL TEMPS", "#1->1000X+5", "#1->X+2Y", "#1->",
    "#1->0", "UNDEFINE", "%50", "$$", "$$*", "??", "%", "LIST PC", "LIST PE", "MOVETIME", "PC",
    "PE", "PR", "/", "\\", "<", ">", "R", "S", "B1", "H", "A", "ABR1", "Q", "MFLUSH", "Q1=1",
    "Q1..3=1", "Q1", "X=5", "Z", "INC(X)", "ABS", "FRAX(X)", "PMATCH", "DEFINE ROT 100",
    "DELETE ROT", "DELETE LOOKAHEAD", "DELETE CCBUFFER", "E", "$", "$*", "HOME", "HOMEZ", "K",
    "O5", "J+", "J-", "J/", "J=", "J=100", "J==100", "J=*", "J:100", "J:*", "J^100", "J^*", "J!",
    "J=100^50", "P", "V", "F", "?", "LIST BLCOMP", "LIST BLCOMP DEF", "LIST COMP",
    "LIST COMP DEF", "LIST TCOMP", "LIST TCOMP DEF", "DEFINE BLCOMP 4,1000", "DELETE BLCOMP",
    "DEFINE COMP 4,1000", "DEFINE COMP 2.2,#1,1000,1000", "DELETE COMP", "DEFINE TCOMP 4,1000",
    "DELETE TCOMP", "VER",
)
ON_LINE_REFUSED: Final = (
    "SETPHASE1", "UPDATE", "STN", "ENABLE PLCC 1", "OPEN BIN ROT", "DELETE PLCC 1",
    "DEFINE TBUF 1", "FSAVE", "FREAD", "FSAVECLEAR", "MACROASCII1", "MACROAUX0,1",
    "MACROAUX0,1=1", "MACROAUXREAD0,1,P1", "MACROAUXWRITE0,1,P1", "MACROMST1,I1",
    "MACROMST1,I1=1", "MACROMSTASCII1", "MACROMSTREAD1,I1,P1", "MACROMSTWRITE1,I1,P1",
    "MACROSLAVE$$$,0", "MACROSLAVE0,I1", "MACROSLAVE0,I1=1", "MACROSLVREAD0,I1,P1",
    "MACROSLVWRITE0,I1,P1", "MACROSTASCII1", "MS0,I1", "MSREAD0,I1,P1", "STN=1", "#1->I",
    "LIST ROTARY", "LIST FORWARD", "LIST INVERSE", "LIST LINK", "LIST LDS", "NOFRAX",
    "DEFINE LOOKAHEAD 100,10", "DEFINE CCBUFFER 10", "LEARN", "OPEN FORWARD", "OPEN INVERSE",
    "D", "!X5", "MSR0,I1,P1", "MSW0,I1,P1", "M1->TWB:1,0", "M1->TWD:0,0,4,U", "M1->TWR:0,0",
    "M1->TWS:1", "IDC",
)
MOTION: Final = (
    "X1000", "X1000Y(P1)", "X1:2", "DWELL10", "DELAY10", "HOME1", "HOME1,2", "HOMEZ1", "LINEAR",
    "RAPID", "PVT100", "SPLINE1", "ABS", "ABS(X)", "INC", "INC(X,Y)", "FRAX(X)", "FRAX",
    "PSETX0", "TM100", "F10", "TA10", "TS5", "I1=1", "P1=1", "Q1=1", "M1=1", "M1==1", "M1&=1",
    "M1|=1", "M1^=1", "N10", "O10", "GOTO10", "GOSUB10", "CALL5.1", "RETURN", "S5",
    "IF(P1=1)P2=1", "IF(P1=1)", "ELSEP1=2", "ELSE", "ENDIF", "WHILE(P1=1)WAIT", "WHILE(P1=1)",
    "ENDWHILE", "BLOCKSTART", "BLOCKSTOP", "STOP", "WAIT", "LOCK0,P1", "UNLOCK0", 'COMMAND"J/"',
    "COMMAND^A", 'COMMANDS"P1"', "COMMANDS^A", 'COMMANDP"P1"', "COMMANDP^A", 'COMMANDR"P1"',
    "COMMANDR^A", 'COMMANDA"P1"', "COMMANDA^A", 'SEND"x"', 'SENDS"x"', 'SENDP"x"', 'SENDR"x"',
    'SENDA"x"', "ENABLE PLC1", "DISABLE PLC1", "PAUSE PLC1", "RESUME PLC1", "GATHER",
    "ENDGATHER", "A5", "B5", "C5", "U5", "V5", "W5", "Y5", "Z5", "PSET X1Y2",
)
MOTION_REFUSED: Final = (
    "X10^-5", "X1Y1I1J1", "X1Y1R5", "CIRCLE1", "CIRCLE2", "SPLINE2", "CC0", "CC1", "CC2", "CC3",
    "CC4", "NOFRAX", "NORMAL K-1", "CCR5", "TR5", "TSEL1", "TINIT", "ADIS1", "IDIS1", "AROT1",
    "IROT1", "SETPHASE1", "NX1", "NY1", "NZ1", "TX1", "TY1", "TZ1", "GOSUB10D5", "CALL5 D3",
    "READ(X)", "G1", "M3", "T5", "D4", "PRELUDE1G1", "PRELUDE0", 'DISPLAY"x"',
    "DISPLAY 1,8.2,P1", "ENABLE PLCC1", "DISABLE PLCC1", "LOOKAHEAD", "MACROAUXREAD0,1,P1",
    "MACROSLVREAD0,I1,P1",
)
PLC: Final = (
    "IF(P1=1)", "WHILE(P1=1)", "AND(P1=1)", "OR(P1=1)", "ELSE", "ENDIF", "ENDWHILE", "I1=1",
    "P1=1", "Q1=1", "M1=1", "ADDRESS#1&1", "ADDRESS#P1", "ADDRESS&P1", 'COMMAND"J/"',
    "COMMAND^A", 'COMMANDS"P1"', 'COMMANDP"P1"', 'COMMANDR"P1"', 'COMMANDA"P1"', 'SEND"x"',
    'SENDS"x"', 'SENDP"x"', 'SENDR"x"', 'SENDA"x"', "ENABLE PLC1", "DISABLE PLC1", "PAUSE PLC1",
    "RESUME PLC1", "LOCK0,P1", "UNLOCK0", "GATHER", "ENDGATHER",
)
PLC_REFUSED: Final = (
    'DISPLAY"x"', "ENABLE PLCC1", "DISABLE PLCC1", "MACROAUXREAD0,1,P1", "MACROAUXWRITE0,1,P1",
    "MACROMSTREAD1,I1,P1", "MACROMSTWRITE1,I1,P1", "MACROSLVREAD0,I1,P1", "MACROSLVWRITE0,I1,P1",
    "SETPHASE1",
)
# fmt: on
